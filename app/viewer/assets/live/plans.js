// A floor's plan and outline: put one under the map, or take it away.

import { byId, put, told } from "./elements.js";
import { may, reload, state } from "./page.js";
import { ask } from "./server.js";

const value = (id) => Number.parseFloat(byId(id).value.replace(",", "."));

export function refresh() {
  byId("plan-form").hidden = state.floor === null || !may("map:write");
  put(byId("plan-told"));
}

export function wire() {
  byId("plan-image").addEventListener("submit", (event) => change(event, async () => {
    const query = new URLSearchParams({
      metres_per_pixel: value("plan-scale"), x_m: value("plan-x"), y_m: value("plan-y"), bearing_rad: (value("plan-turn") * Math.PI) / 180,
    });
    const file = byId("plan-file").files[0];
    await ask("PUT", `v1/floors/${state.floor}/plan?${query}`, { body: file, headers: { "Content-Type": file.type } });
    return "The plan is under the map now.";
  }));
  byId("plan-remove").addEventListener("click", (event) => change(event, async () => {
    await ask("DELETE", `v1/floors/${state.floor}/plan`);
    return "The plan is removed.";
  }));
  byId("outline-form").addEventListener("submit", (event) => change(event, async () => {
    const file = byId("outline-file").files[0];
    await ask("PUT", `v1/floors/${state.floor}/outline?coordinates=${byId("outline-frame").value}`,
      { body: await file.text(), headers: { "Content-Type": "application/geo+json" } });
    return "The outline is drawn now.";
  }));
}

async function change(event, act) {
  event.preventDefault();
  try {
    const done = await act();
    await reload();
    put(byId("plan-told"), told(done, "good"));
  } catch (error) {
    put(byId("plan-told"), told(error));
  }
}
