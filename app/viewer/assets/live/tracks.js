// Tracks: the devices that are followed in the building shown, as they are now. Asked only while somebody looks.

import { byId, make, put, told } from "./elements.js";
import { floorName, flyTo, may, remember, state } from "./page.js";
import { mark } from "./scene.js";
import { ask } from "./server.js";
import { ago, extended, kindOf, marksOf, nameOf, whereabouts } from "./track-marks.js";

const [EVERY_MS, SLOWEST_MS, LISTED, STEPS_BACK] = [1000, 30000, 50, 6000];
const NOTHING = JSON.stringify(marksOf([]));
const known = new Map(); // by id: the track, its last estimate, its path, what of it was read, and its item in the list
let running = false;
let woken = null;
let drawn = NOTHING;
let drawing = Promise.resolve();
let arriving = false; // the chosen one is to be flown to

export function wire() {
  arriving = state.track !== null && state.cameraText === null;
  document.addEventListener("visibilitychange", wake);
}

const watching = () => !byId("tracks").hidden && !document.hidden;

/** Look now, if the tab is open; what is drawn goes when it is closed. */
export function wake() {
  if (byId("tracks").hidden) return draw([]).catch(() => {});
  if (!may("locate")) return put(byId("tracks-fault"), told("This key may not see tracks: it needs the scope locate.", "warn"));
  woken?.();
  if (!running && state.picture) run();
  return null;
}

/** Stay no longer with the track that was chosen. */
export function letGo() {
  state.track = null;
  arriving = false;
  for (const each of known.values()) show(each);
}

async function run() {
  running = true;
  let pause_ms = EVERY_MS;
  while (watching()) {
    const fault = await look().then(() => null, (error) => error);
    pause_ms = fault ? Math.min(2 * pause_ms, SLOWEST_MS) : EVERY_MS;
    sayFault(fault, pause_ms);
    await new Promise((go) => { woken = go; setTimeout(go, pause_ms); });
  }
  running = false;
}

function sayFault(fault, pause_ms) {
  const text = fault ? `${fault.message} What is shown is old; tried again in ${Math.round(pause_ms / 1000)} s.` : "";
  if (byId("tracks-fault").textContent !== text) put(byId("tracks-fault"), fault && told(text, "warn"));
}

async function look() {
  const building = state.building;
  if (!building) return keep([], false);
  const query = new URLSearchParams({ building_id: building, status: "active", order: "newest", limit: LISTED });
  const answer = await ask("GET", `v1/tracks?${query}`, { raw: true });
  const now = Date.parse(answer.headers.get("date")) || Date.now(); // the server's clock, which dated the steps
  const { items, links } = await answer.json();
  for (const track of items.reverse()) await read(track, now).catch(passOver);
  if (building !== state.building) return null;
  keep(items, Boolean(links.next));
  if (watching()) await draw([...known.values()].filter(hasEstimate));
  return stay();
}

/** A track that went away between two requests is no fault. */
function passOver(error) {
  if (error.status !== 404) throw error;
}

const hasEstimate = (each) => each.estimate !== null;
const onStage = (floor) => floor !== null && (state.floor === null || state.floor === floor);

/** What is new of a track: its estimate when steps came, its path when it is drawn. */
async function read(track, now) {
  const each = known.get(track.id) ?? { estimate: null, path: [], read: null, pathRead: null, item: null };
  const seen = `${track.next_step} ${track.last_step_at}`;
  Object.assign(each, { track, age_s: Math.max(0, (now - Date.parse(track.last_step_at)) / 1000) });
  if (each.read !== seen) each.estimate = (await ask("GET", `v1/tracks/${track.id}`)).estimate;
  each.read = seen;
  known.set(track.id, each);
  if (each.pathRead !== seen && onStage(each.estimate.floor_id)) {
    await readPath(each);
    each.pathRead = seen;
  }
  show(each);
}

async function readPath(each) {
  const last = each.path.findLast((point) => point.settled);
  const from_step = last ? last.step + 1 : Math.max(0, each.estimate.step - STEPS_BACK);
  const query = new URLSearchParams({ smoothed: "true", from_step, limit: 5000 });
  each.path = extended(each.path, (await ask("GET", `v1/tracks/${each.track.id}/path?${query}`)).points);
}

/** Let those go that are no longer listed; say so, and say what there is when there is none. */
function keep(items, more) {
  const ids = new Set(items.map((track) => track.id));
  for (const [id, each] of known) if (!ids.has(id)) drop(id, each, more);
  if (state.track && !ids.has(state.track)) {
    letGo();
    remember();
    say("The track that was chosen is not active in this building, or is not your organisation's.");
  }
  byId("tracks-more").hidden = !more;
  byId("tracks-none").hidden = ids.size > 0;
  if (!ids.size && !byId("tracks-none").childElementCount) put(byId("tracks-none"), ...howToBegin());
}

function drop(id, { item, track }, more) {
  item?.root.remove();
  known.delete(id);
  if (track.building_id === state.building && !more) say(`${nameOf(track)} is no longer active.`);
}

const howToBegin = () => [
  make("p", {}, "No device is followed in this building."),
  make("p", { className: "soft" }, "Begin a track with ", make("code", {}, "POST /v1/tracks"), " and send its steps to ",
    make("code", {}, "POST /v1/tracks/{track_id}/steps"), "; docs/tracking.md shows how. It appears here with its first step."),
];

function say(text) {
  byId("tracks-told").textContent = text;
}

/** Draw tracks over the floors, one picture after the other; nothing is sent when nothing changed. */
function draw(tracks) {
  const marks = marksOf(tracks);
  drawing = drawing.catch(() => {}).then(() => send(marks));
  return drawing;
}

async function send(marks) {
  const wanted = JSON.stringify(marks);
  if (wanted === drawn) return;
  drawn = null;
  await mark(marks);
  drawn = wanted;
}

/** Be on the floor of the chosen track; fly to it when it was chosen just now. */
async function stay() {
  const chosen = known.get(state.track);
  if (!chosen?.estimate.position_m) return;
  const { floor_id, position_m, state: how } = chosen.estimate;
  const moved = state.floor !== null && floor_id !== state.floor && how === "converged";
  if (!arriving && !moved) return;
  arriving = false;
  await flyTo(floor_id, position_m);
}

function choose(id) {
  if (state.track === id) letGo();
  else Object.assign(state, { track: id });
  arriving = state.track !== null;
  for (const each of known.values()) show(each);
  remember();
  return stay().catch((error) => put(byId("tracks-fault"), told(error)));
}

/** A track's item in the list: made once, and then only what changed is written. */
function show(each) {
  const { track, estimate } = each;
  each.item ??= newItem(track.id);
  const { button, name, badge, where, why, age } = each.item;
  const floor = estimate.floor_id ? floorName(estimate.floor_id) : "floor not known";
  const now = `${estimate.state}, ${floor}`;
  if (each.item.said !== now) say(`${nameOf(track)}: ${now}.`);
  each.item.said = now;
  write(name, nameOf(track));
  write(badge, estimate.state);
  badge.className = `badge ${kindOf(estimate)}`;
  write(where, `${floor}: ${whereabouts(each)}`);
  write(why, estimate.reason ?? "");
  why.hidden = !estimate.reason;
  write(age, `last step ${ago(each.age_s)}`);
  button.setAttribute("aria-pressed", String(state.track === track.id));
}

function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function newItem(id) {
  const [name, badge, where, why, age] = ["b", "span", "div", "div", "div"].map((tag) => make(tag));
  why.className = age.className = "soft";
  const button = make("button", { type: "button", className: "track" }, name, badge);
  button.addEventListener("click", () => choose(id));
  const root = make("div", { className: "item", role: "listitem" }, button, where, why, age);
  byId("track-list").prepend(root); // the newest first
  return { root, button, name, badge, where, why, age, said: null };
}
