// Versions of a floor's map, and the jobs that make them.

import { byId, make, number, put, told } from "./elements.js";
import { offer } from "./field.js";
import { floorName, may, redraw, reload, state } from "./page.js";
import { ask } from "./server.js";
import * as surveys from "./surveys.js";

const OPEN = ["accepted", "running"];
const watched = new Map();
let newestAtFirst = null;
let looking = null;

export function wire() {
  byId("build").disabled = !may("map:write");
  byId("build").addEventListener("click", async () => {
    if (!state.floor) return put(byId("build-told"), told("Choose one floor first.", "warn"));
    try {
      const { job } = await ask("POST", `v1/floors/${state.floor}/maps`, { json: {} });
      put(byId("build-told"));
      watch(job);
    } catch (error) {
      put(byId("build-told"), told(error));
    }
    return null;
  });
  setInterval(findJobs, 3000);
  findJobs();
}

/** Jobs that somebody else started are found, too: those still open, and those that ended since the page was opened. */
async function findJobs() {
  if (document.hidden) return;
  const page = await ask("GET", "v1/jobs?order=newest&limit=8").catch(() => ({ items: [] }));
  newestAtFirst ??= page.items[0]?.id ?? "";
  const fresh = page.items.filter((job) => OPEN.includes(job.status) || job.id > newestAtFirst); // ids sort by time
  for (const job of fresh.reverse()) if (!watched.has(job.id)) watch({ ...job, status: "running" });
}

/** Follow a job to its end with a progress bar; then show what it made. */
export function watch(job) {
  watched.set(job.id, job);
  draw();
  looking ??= setInterval(look, 700);
}

async function look() {
  let ended = false;
  for (const [id, job] of watched) {
    if (!OPEN.includes(job.status)) continue;
    const now = await ask("GET", `v1/jobs/${id}`).catch(() => null);
    if (!now) continue;
    watched.set(id, now);
    ended ||= !OPEN.includes(now.status);
  }
  draw();
  if (ended) {
    await reload();
    refresh();
    surveys.refresh();
  }
  if (![...watched.values()].some((job) => OPEN.includes(job.status))) {
    clearInterval(looking);
    looking = null;
  }
}

function draw() {
  const jobs = [...watched.values()].slice(-6).reverse();
  byId("tab-maps").textContent = jobs.some((job) => OPEN.includes(job.status)) ? "Maps …" : "Maps";
  put(byId("jobs"), ...jobs.map(jobItem));
}

function jobItem(job) {
  const open = OPEN.includes(job.status);
  const kind = { successful: "good", failed: "bad" }[job.status] ?? "";
  const cancel = make("button", { type: "button", className: "quiet", disabled: !may("map:write") }, "Cancel");
  cancel.addEventListener("click", () => ask("DELETE", `v1/jobs/${job.id}`).then(look).catch(() => {}));
  return make("div", { className: "item" }, make("b", {}, `${job.kind} of ${floorName(job.floor_id)}`),
    make("span", { className: `badge ${kind}` }, job.status),
    open ? make("progress", { max: 100, value: job.progress, "aria-label": `${job.kind}: ${job.progress} %` }) : null,
    make("div", { className: "soft" }, job.message), open ? make("div", { className: "row" }, cancel) : null);
}

export async function refresh() {
  const floor = state.floor;
  state.versions = {};
  if (!floor) {
    put(byId("map-list"), make("p", { className: "soft" }, "Choose one floor to see its maps."));
    return;
  }
  try {
    const maps = (await ask("GET", `v1/floors/${floor}/maps?order=newest&limit=30`)).items;
    if (floor !== state.floor) return;
    const ready = maps.filter((map) => map.status === "ready");
    state.versions = Object.fromEntries(ready.map((map) => [map.id, title(map)]));
    put(byId("map-list"), ...(maps.length ? maps.map(item) : [make("p", { className: "soft" }, "There is none yet.")]));
    offer(state);
  } catch (error) {
    put(byId("map-list"), told(error));
  }
}

const title = (map) => `${new Date(map.created_at).toLocaleString()}, ${map.survey_ids.length} surveys${map.active ? ", published" : ""}`;

function item(map) {
  const shown = map.id === state.picture?.map_id;
  const ready = map.status === "ready";
  const rmse = map.score ? `left-out surveys differ by ${map.score.rmse_ut.map((v) => number(v, 2)).join(", ")} µT` : (map.score_reason ?? "");
  const button = (text, act, disabled = false) => {
    const made = make("button", { type: "button", className: "quiet", disabled: !ready || disabled }, text);
    made.addEventListener("click", act);
    return made;
  };
  return make("div", { className: "item" }, make("b", {}, new Date(map.created_at).toLocaleString()),
    map.active ? make("span", { className: "badge good" }, "published") : null,
    ready ? null : make("span", { className: "badge" }, map.status), shown ? make("span", { className: "badge" }, "shown") : null,
    make("div", { className: "soft" }, `${map.engine}, ${map.components ?? ""}, ${map.survey_ids.length} surveys. ${rmse}`),
    make("div", { className: "row" },
      button("Show", () => { state.map = map.id; redraw().then(refresh); }, shown),
      button("Compare", () => { Object.assign(state, { versus: map.id, layer: "difference" }); redraw().then(refresh); }, shown),
      button(map.active ? "Published" : "Publish", () => publish(map), map.active || !may("map:write"))));
}

async function publish(map) {
  try {
    await ask("POST", `v1/maps/${map.id}/activate`);
    state.map = null;
    await reload();
    put(byId("build-told"), told("Published: positions are found on this map from now on.", "good"));
  } catch (error) {
    put(byId("build-told"), told(error));
  }
  refresh();
}
