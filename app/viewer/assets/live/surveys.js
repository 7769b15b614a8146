// Surveys: drop them, read their reports, leave one out and see the map change.

import { byId, dropZone, make, number, put, table, told } from "./elements.js";
import * as maps from "./maps.js";
import { may, state } from "./page.js";
import { all, ask, howToSend } from "./server.js";

export function wire() {
  if (!may("survey:write")) {
    byId("survey-drop").replaceChildren(make("p", {}, "This key may not upload surveys: it needs the scope survey:write."));
  } else {
    byId("survey-file").addEventListener("change", (event) => upload([...event.target.files]));
    dropZone(byId("survey-drop"), upload);
  }
}

async function upload(files) {
  put(byId("uploads"));
  if (!state.floor) {
    put(byId("uploads"), told("Choose one floor first: surveys belong to a floor.", "warn"));
    return;
  }
  for (const file of files) {
    const line = make("div", { className: "item" }, make("b", {}, file.name), " uploading…");
    byId("uploads").append(line);
    try {
      const { format, headers } = howToSend(file);
      const query = new URLSearchParams({ format, frame: byId("survey-frame").value, name: file.name });
      const { survey, job } = await ask("POST", `v1/floors/${state.floor}/surveys?${query}`, { body: file, headers });
      put(line, make("b", {}, file.name), ` received: ${survey.sample_count.toLocaleString("en")} samples`, await reportOf(survey.id));
      if (job) maps.watch(job);
    } catch (error) {
      put(line, make("b", {}, file.name), told(error));
    }
  }
  refresh();
}

async function reportOf(id) {
  const report = await ask("GET", `v1/surveys/${id}/report`);
  const warnings = (report.warnings ?? []).map((w) => told(String(w), "warn"));
  const facts = Object.entries(report).filter(([, v]) => ["string", "number", "boolean"].includes(typeof v));
  const assumed = (report.assumptions ?? []).map((a) => make("li", {}, String(a)));
  return make("div", {}, ...warnings, await disturbancesOf(id), make("details", {}, make("summary", {}, "What was read"),
    assumed.length ? make("ul", {}, ...assumed) : null,
    table(["", ""], facts.map(([name, value]) => [name.replaceAll("_", " "), typeof value === "number" ? number(value, 5) : String(value)]))));
}

/** Stretches over which the field was disturbed, with what leaves them out of maps; nothing where there are none. */
async function disturbancesOf(id) {
  const { stretches, excluded_s: left } = await ask("GET", `v1/surveys/${id}/disturbances`);
  if (!stretches.length && !left.length) return null;
  const said = make("div");
  const change = (label, json) => {
    const button = make("button", { type: "button" }, label);
    button.addEventListener("click", async () => {
      try {
        const { excluded_s: now, job } = await ask("PATCH", `v1/surveys/${id}`, { json });
        put(said, told(now.length ? `${now.length} stretches are left out of maps.` : "All of it is in maps again.", "good"));
        if (job) maps.watch(job);
      } catch (error) {
        put(said, told(error));
      }
    });
    return button;
  };
  return make("div", {},
    make("p", {}, stretches.length ? "The field was disturbed:" : "No stretch is disturbed any more."),
    make("ul", {}, ...stretches.map((s) => make("li", {}, `${number(s.start_s, 4)} to ${number(s.end_s, 4)} s: ${s.reason}`))),
    may("survey:write") && stretches.length ? change("Leave these stretches out of maps", { exclude_disturbed: true }) : null,
    may("survey:write") && left.length ? change("Take all in again", { excluded_s: [] }) : null, said);
}

export async function refresh() {
  const floor = state.floor;
  if (!floor) {
    put(byId("survey-list"), make("p", { className: "soft" }, "Choose one floor to see its surveys."));
    return;
  }
  try {
    const [surveys, consistency] = await Promise.all([all(`v1/floors/${floor}/surveys`), judged()]);
    if (floor !== state.floor) return;
    put(byId("survey-list"), ...(surveys.length ? surveys.map((s) => item(s, consistency[s.id]))
      : [make("p", { className: "soft" }, "There are none yet. Drop one above.")]));
  } catch (error) {
    put(byId("survey-list"), told(error));
  }
}

/** How the map's quality report judges each survey; nothing without a map. */
async function judged() {
  const map = state.picture?.map_id;
  if (!map) return {};
  const quality = await ask("GET", `v1/maps/${map}/quality`).catch(() => ({}));
  return quality.surveys ?? {};
}

function item(survey, judgement) {
  const box = make("input", { type: "checkbox", checked: survey.included, disabled: !may("survey:write") });
  const said = make("div");
  box.addEventListener("change", async () => {
    try {
      const { job } = await ask("PATCH", `v1/surveys/${survey.id}`, { json: { included: box.checked } });
      put(said, told(job ? "The map is being built anew; see the tab Maps." : "Saved. This floor does not build by itself: build it in the tab Maps.", "good"));
      if (job) maps.watch(job);
    } catch (error) {
      box.checked = !box.checked;
      put(said, told(error));
    }
  });
  const kind = { consistent: "good", inconsistent: "bad" }[judgement?.status] ?? "";
  const details = make("details", {}, make("summary", {}, "Report"));
  details.addEventListener("toggle", async () => {
    if (details.open && details.childElementCount === 1) details.append(...(await reportOf(survey.id)).childNodes);
  });
  return make("div", { className: "item" },
    make("label", {}, box, " ", make("b", {}, survey.name), judgement ? make("span", { className: `badge ${kind}` }, judgement.status) : null),
    make("div", { className: "soft" }, `${survey.sample_count.toLocaleString("en")} samples, ${survey.format}, `
      + `${new Date(survey.created_at).toLocaleString()}${judgement?.reason ? `. ${judgement.reason}` : ""}`),
    details, said);
}
