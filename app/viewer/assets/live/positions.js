// Positions: where a window is, and a walk replayed against where it was.

import { byId, dropZone, make, number, put, table, told } from "./elements.js";
import { describe } from "./field.js";
import { floorName, may, redraw, state } from "./page.js";
import { mark as draw } from "./scene.js";
import { ask, howToSend } from "./server.js";

const STATUS = { fix: "good", ambiguous: "warn", inconsistent: "warn", unmapped: "warn" };
let replayed = null;
let playing = null;
let quieted = null;

/** Draw over the floors, and say in the legend what the colours mean. */
async function mark(marks) {
  state.likelihoodLegend = (await draw(marks)).likelihood_legend;
  if (state.picture) describe(state.picture, state.likelihoodLegend);
}

export function wire() {
  if (!may("locate")) {
    put(byId("answer"), told("This key may not locate: it needs the scope locate.", "warn"));
    for (const id of ["locate", "walk-file", "window-file"]) byId(id).disabled = true;
  }
  byId("locate").addEventListener("click", locate);
  byId("clear").addEventListener("click", forget);
  byId("window-file").addEventListener("change", (event) => take(event.target.files));
  dropZone(byId("window-drop"), take);
  byId("walk-file").addEventListener("change", (event) => event.target.files.length && replay(event.target.files[0]));
  dropZone(byId("walk-drop"), ([file]) => file && replay(file));
  byId("replay-at").addEventListener("input", (event) => { stop(); step(event.target.valueAsNumber); });
  byId("replay-play").addEventListener("click", play);
}

async function take(files, text) {
  byId("window").value = files.length ? await files[0].text() : text;
  locate();
}

/** Drop what is drawn and said about positions. */
export function forget() {
  stop();
  replayed = null;
  put(byId("answer"));
  put(byId("replay"));
  byId("replay-row").hidden = true;
  if (quieted) show(quieted);
  quieted = null;
  return mark({}).catch(() => {});
}

async function locate() {
  let body;
  try {
    body = JSON.parse(byId("window").value);
  } catch (error) {
    put(byId("answer"), told(`This is not JSON: ${error.message}`));
    return;
  }
  body = body && typeof body === "object" && "window" in body ? body : { window: body };
  const place = state.floor ? `floors/${state.floor}` : `buildings/${state.building}`;
  if (state.floor) delete body.floor_ids;
  put(byId("answer"), make("p", { className: "soft" }, "Searching…"));
  try {
    const fix = await ask("POST", `v1/${place}/locate?explain=true`, { json: body });
    put(byId("answer"), ...inWords(fix));
    await mark(marksOf(fix));
    if (state.picture.walks || state.arrows) quieten();
  } catch (error) {
    put(byId("answer"), told(error));
  }
}

/** Field arrows would hide a likelihood: they are switched off, and the box says so. */
function quieten() {
  quieted ??= { arrows: state.arrows, walks: state.walks };
  show({ arrows: false, walks: false });
}

function show(kinds) {
  Object.assign(state, kinds);
  byId("arrows").checked = state.arrows;
  return redraw();
}

function marksOf(fix) {
  const belief = fix.posterior;
  if (!belief) return {};
  return {
    likelihood: fix.explanation?.likelihood ?? null,
    modes: belief.modes.slice(0, 20),
    ellipses: [{ floor_id: belief.floor_id, position_m: belief.position_m, covariance_m2: belief.covariance_m2 }],
  };
}

function inWords(fix) {
  const head = make("p", {}, make("span", { className: `badge ${STATUS[fix.status]}` }, fix.status));
  const why = fix.reason ? told(fix.reason, "warn") : null;
  if (!fix.posterior) return [head, why];
  const p = fix.posterior;
  const where = `${floorName(p.floor_id)}, x ${p.position_m[0].toFixed(2)} m, y ${p.position_m[1].toFixed(2)} m; `
    + `within ${number(p.radius_95_m, 2)} m with 95 %`;
  const rows = Object.entries(fix.estimates).map(([name, e]) => [name.toUpperCase(), e.available
    ? `x ${e.position_m[0].toFixed(2)}, y ${e.position_m[1].toFixed(2)}` : `no answer: ${e.reason}`]);
  return [head, make("p", {}, make("b", {}, where)), why, table(["Technique", "Position, m"], rows),
    make("p", { className: "soft" }, `Off the map with ${(100 * p.off_map_probability).toFixed(0)} %. The bright surface is the `
      + "likelihood of the last sample's place, fading out 20 nats below the best; the line is the 95 % ellipse.")];
}

async function replay(file) {
  await forget();
  if (!state.floor) {
    put(byId("replay"), told("Choose one floor first: a walk is replayed on a floor's map.", "warn"));
    return;
  }
  try {
    const { format, headers } = howToSend(file);
    const query = new URLSearchParams({ format, frame: byId("walk-frame").value, window_m: byId("window-m").value || "10" });
    const answer = await ask("POST", `v1/floors/${state.floor}/replay?${query}`, { body: file, headers, raw: true });
    await follow(answer.body, file.name);
  } catch (error) {
    put(byId("replay"), told(error));
  }
}

/** Read the answers line by line as they come, and draw each. */
async function follow(stream, name) {
  const reader = stream.pipeThrough(new TextDecoderStream()).getReader();
  const mine = { name, path: null, windows: [], floor: state.floor };
  replayed = mine;
  let rest = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done || replayed !== mine) break;
    const pieces = (rest + value).split("\n");
    rest = pieces.pop();
    for (const piece of pieces.filter(Boolean)) {
      const line = JSON.parse(piece);
      if (line.kind === "path") begin(line);
      else arrive(line);
    }
  }
  if (replayed === mine) {
    summarise();
    if (state.arrows) quieten();
  }
}

function begin(line) {
  replayed.path = line.path_m;
  byId("replay-progress").max = line.windows;
  byId("replay-row").hidden = false;
}

function arrive(line) {
  replayed.windows.push(line);
  const count = replayed.windows.length;
  byId("replay-progress").value = count;
  byId("replay-at").max = count - 1;
  byId("replay-at").value = count - 1;
  step(count - 1);
}

let drawing = false;
let next = null;

/** Draw the walk up to its k-th window; while one is drawn only the latest is kept. */
async function step(k) {
  next = k;
  if (drawing) return;
  drawing = true;
  while (next !== null && replayed) {
    const now = next;
    next = null;
    say(now);
    await mark(marksAt(now)).catch(() => {});
  }
  drawing = false;
}

const answered = (w) => w.position_m !== null && (w.status === "fix" || w.status === "ambiguous");

function marksAt(k) {
  const w = replayed.windows[k];
  const seen = replayed.windows.slice(0, k + 1).filter(answered).map((each) => each.position_m);
  const floor_id = replayed.floor;
  return {
    paths: [{ floor_id, kind: "truth", points_m: replayed.path }, { floor_id, kind: "estimate", points_m: seen }],
    ellipses: w.position_m ? [{ floor_id, position_m: w.position_m, covariance_m2: w.covariance_m2 }] : [],
    modes: w.position_m ? [{ floor_id, position_m: w.position_m, probability: w.probability ?? 0 }] : [],
  };
}

function say(k) {
  const w = replayed.windows[k];
  byId("replay-out").textContent = `${k + 1} of ${replayed.windows.length}: ${w.status}`
    + (w.error_m === null ? "" : `, ${w.error_m.toFixed(2)} m off, 95 % within ${number(w.radius_95_m, 2)} m`);
}

function summarise() {
  const { windows, name } = replayed;
  const fixes = windows.filter((w) => w.status === "fix");
  const errors = fixes.map((w) => w.error_m).sort((a, b) => a - b);
  const held = fixes.filter((w) => w.error_m <= w.radius_95_m).length;
  const middle = errors.length ? `${errors[Math.floor(errors.length / 2)].toFixed(2)} m` : "–";
  put(byId("replay"), make("p", {}, make("b", {}, name)), table(["", "Windows"], [
    ["located", windows.length], ["a fix", fixes.length], ["median error of fixes", middle],
    ["truth within the stated 95 %", fixes.length ? `${held} of ${fixes.length}` : "–"],
  ]), make("p", { className: "soft" }, "White: where the walk was. Orange: where it was located."));
}

function stop() {
  clearInterval(playing);
  playing = null;
  byId("replay-play").textContent = "Play";
}

function play() {
  if (playing) return stop();
  let k = Number(byId("replay-at").value) + 1 >= replayed.windows.length ? 0 : Number(byId("replay-at").value);
  byId("replay-play").textContent = "Pause";
  playing = setInterval(() => {
    if (!replayed || k >= replayed.windows.length) return stop();
    byId("replay-at").value = k;
    step(k++);
    return null;
  }, 300);
  return null;
}
