// The page: what is chosen, the pickers, the address, and the parts that go with each tab.

import { byId, make, options, put, told } from "./elements.js";
import { describe, offer, readPlace, showPicked, showTip } from "./field.js";
import * as maps from "./maps.js";
import * as plans from "./plans.js";
import * as positions from "./positions.js";
import { camera, show, showPoster, watchPointer } from "./scene.js";
import { ask } from "./server.js";
import * as surveys from "./surveys.js";
import * as tracks from "./tracks.js";

const LINKED = ["building", "floor", "map", "versus", "layer", "height", "camera", "track"];
const asked = Object.fromEntries(new URLSearchParams(location.search));

/** What is chosen now; ids are null for "all" and "the active one". */
export const state = {
  building: asked.building ?? null, floor: asked.floor ?? null, map: asked.map ?? null, versus: asked.versus ?? null,
  layer: asked.layer ?? "norm", height: number(asked.height), arrows: true, walks: null, outline: true, plan: true,
  separation: null, camera: pose(asked.camera) ?? "keep", cameraText: asked.camera ?? null, track: asked.track ?? null, content: null, picture: null,
  likelihoodLegend: null, versions: {},
};

export const may = (...scopes) => state.content.scopes.includes("admin") || scopes.some((s) => state.content.scopes.includes(s));
export const floorName = (id) => state.content.buildings.flatMap((b) => b.floors).find((f) => f.id === id)?.name ?? "another floor";

function number(text) {
  const value = Number.parseFloat(text);
  return Number.isFinite(value) ? value : null;
}

function pose(text) {
  const values = (text ?? "").split(",").map(Number);
  if (values.length !== 6 || !values.every(Number.isFinite)) return null;
  return { position_m: values.slice(0, 3), look_at_m: values.slice(3) };
}

/** Draw what is chosen. */
export function redraw(cameraWish = "keep") {
  const wanted = {
    building_id: state.building, floor_id: state.floor, map_id: state.map, versus_id: state.versus, layer: state.layer,
    height_m: state.height, arrows: state.arrows, walks: state.walks, outline: state.outline, plan: state.plan,
    separation_m: state.separation, camera: cameraWish,
    aspect: Math.min(10, Math.max(0.1, byId("stage").clientWidth / byId("stage").clientHeight)),
  };
  return show(wanted, drawn, (error) => put(byId("notes"), told(error)));
}

function drawn(picture) {
  const first = state.picture === null;
  const moved = !first && (picture.floor_id !== state.picture.floor_id || picture.building_id !== state.picture.building_id);
  Object.assign(state, { picture, building: picture.building_id, floor: picture.floor_id, layer: picture.layer });
  byId("walks").checked = picture.walks;
  put(byId("notes"), ...picture.notes.map((note) => told(note, "warn")));
  offerFloors();
  offer(state);
  describe(picture, state.likelihoodLegend);
  remember();
  if (first || moved) {
    surveys.refresh();
    maps.refresh();
    plans.refresh();
    tracks.wake();
  }
}

function offerFloors() {
  const { buildings } = state.content;
  const chosen = buildings.find((b) => b.id === state.building);
  options(byId("building"), buildings.map((b) => [b.id, b.name]), state.building);
  const floors = chosen?.floors ?? [];
  const all = floors.length > 1 ? [["", "All floors"]] : [];
  options(byId("floor"), [...all, ...floors.map((f) => [f.id, f.map_id ? f.name : `${f.name} (no map)`])], state.floor);
}

/** Put what is seen into the address, so that it can be sent to somebody. */
export function remember() {
  const link = {
    building: state.floor ? null : state.building, floor: state.floor, map: state.map, versus: state.versus,
    layer: state.layer, height: state.height, camera: state.cameraText, track: state.track,
  };
  const query = new URLSearchParams();
  for (const name of LINKED) if (link[name] !== null && link[name] !== "") query.set(name, link[name]);
  history.replaceState(null, "", `?${query}`.replaceAll("%2C", ","));
}

async function rememberCamera() {
  const seen = await camera().catch(() => null);
  if (!seen) return;
  state.cameraText = [...seen.position_m, ...seen.look_at_m].map((v) => Number(v.toFixed(4))).join(",");
  remember();
}

/** Choose a floor (null: all) of a building, and look at it from the usual place. */
function choose(building, floor) {
  turnTo(building, floor);
  state.cameraText = null;
  positions.forget();
  tracks.letGo();
  return redraw("oblique");
}

function turnTo(building, floor) {
  Object.assign(state, { building, floor, map: null, versus: null, walks: null, height: null, separation: null });
}

/** Look at a place from where the camera is turned now, but near; its floor is shown. */
export async function flyTo(floor, place_m) {
  const seen = await camera().catch(() => null);
  if (floor !== state.floor) turnTo(state.building, floor);
  await redraw(nearPose(seen, place_m));
  return rememberCamera();
}

const [NEAREST_M, FARTHEST_M] = [6, 14];

function nearPose(seen, look_at_m) {
  const away = seen ? seen.position_m.map((v, k) => v - seen.look_at_m[k]) : [0, -8, 8];
  const far = Math.hypot(...away) || 1;
  const wanted = Math.min(FARTHEST_M, Math.max(NEAREST_M, far));
  return { position_m: look_at_m.map((v, k) => v + (away[k] * wanted) / far), look_at_m };
}

/** Read the pickers' content anew, after something changed, and draw. */
export async function reload() {
  state.content = await ask("GET", "content");
  await redraw();
}

function wire() {
  byId("building").addEventListener("change", (event) => choose(event.target.value, null));
  byId("floor").addEventListener("change", (event) => choose(state.building, event.target.value || null));
  for (const kind of ["arrows", "walks", "outline", "plan"]) {
    byId(kind).addEventListener("change", (event) => { state[kind] = event.target.checked; redraw(); });
  }
  byId("layer").addEventListener("change", (event) => { state.layer = event.target.value; redraw(); });
  byId("versus").addEventListener("change", (event) => {
    state.versus = event.target.value || null;
    state.layer = state.versus ? "difference" : "norm";
    redraw();
  });
  byId("height").addEventListener("input", (event) => {
    state.height = state.picture.heights_m[event.target.valueAsNumber];
    redraw();
  });
  byId("separation").addEventListener("input", (event) => { state.separation = event.target.valueAsNumber; redraw(); });
  byId("oblique").addEventListener("click", () => { state.cameraText = null; redraw("oblique"); });
  byId("top").addEventListener("click", () => redraw("top").then(rememberCamera));
  byId("copy-link").addEventListener("click", copyLink);
  byId("help-button").addEventListener("click", (event) => {
    byId("help").hidden = !byId("help").hidden;
    event.target.setAttribute("aria-expanded", String(!byId("help").hidden));
  });
  byId("place").addEventListener("submit", (event) => { event.preventDefault(); readPlace(state); });
  watchPointer({ hovered: showTip, clicked: showPicked, moved: rememberCamera });
  wireTabs();
  wireSession();
}

async function copyLink() {
  await rememberCamera();
  let how = "The link is copied: it shows what you see now.";
  try {
    await navigator.clipboard.writeText(location.href);
  } catch { // no clipboard without TLS: the address bar has it
    how = "The address of this page now shows what you see; copy it from there.";
  }
  put(byId("notes"), told(how, "good"));
}

function wireTabs() {
  const tabs = [...document.querySelectorAll("[role=tab]")];
  const open = (tab) => {
    for (const each of tabs) {
      each.setAttribute("aria-selected", String(each === tab));
      each.tabIndex = each === tab ? 0 : -1;
      byId(each.getAttribute("aria-controls")).hidden = each !== tab;
    }
    tracks.wake();
  };
  for (const [k, tab] of tabs.entries()) {
    tab.addEventListener("click", () => open(tab));
    tab.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!step) return;
      const next = tabs[(k + step + tabs.length) % tabs.length];
      open(next);
      next.focus();
    });
  }
}

/** The sign-in page comes when the session ends. */
function wireSession() {
  const look = () => fetch("session", { cache: "no-store" })
    .then((answer) => { if (answer.status === 401) location.reload(); }).catch(() => {});
  setInterval(look, 60000);
  document.addEventListener("visibilitychange", () => { if (!document.hidden) look(); });
}

async function start() {
  showPoster();
  wire();
  state.content = await ask("GET", "content");
  positions.wire();
  surveys.wire();
  maps.wire();
  plans.wire();
  tracks.wire();
  await redraw(state.camera);
  if (state.track) byId("tab-tracks").click();
}

start().catch((error) => put(byId("notes"), told(error)));
