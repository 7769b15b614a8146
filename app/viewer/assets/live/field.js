// The field in words: layers, legends, the value at a place, and the floors as a table.

import { byId, make, number, options, put, table, told } from "./elements.js";
import { ask } from "./server.js";

const LABELS = { bx: "Bx", by: "By", bz: "Bz", horizontal: "Horizontal", vertical: "Vertical (up)", norm: "|B|" };

/** Bring the controls in line with what is shown. */
export function offer(state) {
  const { picture } = state;
  const versions = Object.entries(state.versions ?? {}).filter(([id]) => id !== picture.map_id);
  const comparable = picture.floor_id !== null && versions.length > 0;
  const layers = picture.layers.map((layer) => [layer.name, layer.title]);
  options(byId("layer"), layers, picture.layer);
  byId("about-layer").textContent = picture.layers.find((layer) => layer.name === picture.layer)?.about ?? "";
  byId("versus-row").hidden = !comparable;
  if (comparable) options(byId("versus"), [["", "no other version"], ...versions], state.versus);
  byId("height-row").hidden = picture.heights_m.length < 2 || picture.floor_id === null;
  byId("height").max = picture.heights_m.length - 1;
  byId("height").value = picture.heights_m.indexOf(picture.height_m);
  byId("height-out").textContent = picture.height_m === null ? "" : `${picture.height_m.toFixed(2)} m`;
  byId("separation-row").hidden = picture.floors.length < 2;
  byId("separation").value = picture.separation_m;
  byId("separation-out").textContent = `${picture.separation_m.toFixed(1)} m`;
}

/** The legends over the canvas, and the picture in words. */
export function describe(picture, likelihood = null) {
  const bars = [likelihood, picture.legend, picture.walks_legend].filter(Boolean).map(bar);
  byId("legend").hidden = bars.length === 0;
  put(byId("legend"), ...bars);
  const unit = picture.legend?.unit ?? "";
  const rows = picture.floors.map((floor) => [
    floor.name, number(floor.median), floor.low === null ? "–" : `${number(floor.low)} to ${number(floor.high)}`,
    `${Math.round(floor.measured_m2).toLocaleString("en")} m²`, floor.walks,
  ]);
  put(byId("words"),
    table(["Floor", `Median${unit ? `, ${unit}` : ""}`, "90 % of it", "Measured", "Walks"], rows),
    make("p", { className: "soft" }, `${picture.legend?.title ?? "Nothing mapped yet"}. Ground squares are ${picture.ground_m} m; `
      + `${picture.arrows.toLocaleString("en")} field arrows are drawn.`));
}

function bar({ title, unit, colours, ticks }) {
  const label = unit ? `${title}, ${unit}` : title;
  const strip = make("div", { className: "bar", role: "img", "aria-label": `${label}: from ${ticks[0]} to ${ticks.at(-1)}` });
  strip.style.background = `linear-gradient(to right, ${colours.join(", ")})`;
  return make("div", { className: "legend-of" }, make("div", {}, label), strip,
    make("div", { className: "ticks" }, ...ticks.map((tick) => make("span", {}, tick.replace("-", "−")))));
}

/** What the pointer rests on, beside it. */
export function showTip(picked, x, y) {
  const tip = byId("tip");
  tip.hidden = !picked;
  if (!picked) return;
  put(tip, ...lines(picked).slice(0, 5).map((line) => make("div", {}, line)));
  const stage = byId("stage").getBoundingClientRect();
  tip.style.left = `${Math.min(x + 16, stage.width - tip.offsetWidth - 8)}px`;
  tip.style.top = `${Math.min(y + 16, stage.height - tip.offsetHeight - 8)}px`;
}

function lines(picked) {
  const where = `${picked.floor}, x ${picked.point_m[0].toFixed(2)} m, y ${picked.point_m[1].toFixed(2)} m`;
  if (!picked.measured) return [where, "not measured here"];
  const own = picked.layer_value === null ? [] : [`${picked.layer_title}: ${number(picked.layer_value, 4)} ${picked.layer_unit}`];
  const parts = picked.components.map((name, k) => `${LABELS[name]} ${withSd(picked.mean_ut[k], picked.sd_ut[k])}`);
  return [where, ...(picked.layer === "norm" ? [] : own), `|B| ${picked.norm_ut.toFixed(2)} µT`, ...parts];
}

const withSd = (mean, sd) => `${mean.toFixed(2)} ± ${sd.toFixed(2)} µT`.replaceAll("-", "−");

/** A value that was clicked stays in the controls, with the surveys behind it; what is typed meanwhile is left alone. */
export function showPicked(picked, typed = false) {
  if (!picked) {
    put(byId("picked"), make("p", { className: "soft" }, "There is no map at that point."));
    return;
  }
  if (!typed) {
    byId("place-x").value = picked.point_m[0].toFixed(2);
    byId("place-y").value = picked.point_m[1].toFixed(2);
  }
  const facts = [["Place", `${picked.floor}, x ${picked.point_m[0].toFixed(2)} m, y ${picked.point_m[1].toFixed(2)} m`]];
  if (!picked.measured) facts.push(["Field", "not measured here: no survey came near enough"]);
  else {
    facts.push(["|B|", `${picked.norm_ut.toFixed(2)} µT`]);
    if (picked.components[0] !== "norm" || picked.components.length > 1) {
      picked.components.forEach((name, k) => facts.push([LABELS[name], withSd(picked.mean_ut[k], picked.sd_ut[k])]));
    } else facts.push(["sd", `${picked.sd_ut[0].toFixed(2)} µT`]);
    if (picked.layer !== "norm" && picked.layer_value !== null && !picked.components.includes(picked.layer)) {
      facts.push([picked.layer_title, `${number(picked.layer_value, 4)} ${picked.layer_unit}`]);
    }
  }
  put(byId("picked"),
    make("dl", {}, ...facts.flatMap(([name, value]) => [make("dt", {}, name), make("dd", {}, value)])),
    support(picked.surveys));
}

function support(surveys) {
  if (!surveys) return null;
  if (surveys.length === 0) return make("p", { className: "soft" }, "No survey came within a metre: the value is carried over from farther away.");
  const rows = surveys.slice(0, 8).map((s) => [s.name, `${s.nearest_m.toFixed(2)} m`,
    s.residual_ut === null ? "–" : s.residual_ut.map((v) => v.toFixed(1).replace("-", "−")).join(", ")]);
  return make("div", {}, table([`Surveys within 1 m: ${surveys.length}`, "Nearest", "Less the map, µT"], rows));
}

/** The value at a typed place, from the API. */
export async function readPlace(state) {
  const floor = state.picture.floors.find((each) => each.map_id);
  if (!floor) return put(byId("picked"), told("This floor has no map yet.", "warn"));
  const [x, y] = [byId("place-x"), byId("place-y")].map((field) => Number.parseFloat(field.value.replace(",", ".")));
  if (!Number.isFinite(x) || !Number.isFinite(y)) return put(byId("picked"), told("Type x and y in metres, for example 12.5."));
  const z = state.picture.height_m ?? 0;
  try {
    const answer = await ask("POST", `v1/maps/${floor.map_id}/field`, { json: { points_m: [[x, y, z]] } });
    const measured = answer.measured[0];
    showPicked({
      floor: floor.name, point_m: [x, y, z], measured, components: answer.components, mean_ut: answer.mean_ut[0],
      sd_ut: answer.sd_ut[0], norm_ut: measured ? Math.hypot(...answer.mean_ut[0]) : null, layer: "norm", layer_value: null,
    }, true);
  } catch (error) {
    put(byId("picked"), told(error));
  }
  return null;
}
