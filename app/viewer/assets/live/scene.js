// The canvas: what it shows, where its camera is, and what the pointer points at.

import { ask } from "./server.js";
import { byId } from "./elements.js";

const frame = byId("canvas");
const path = frame.getAttribute("src"); // names a view of this page's own
/** While the canvas starts, the map from above; it goes once the canvas has drawn what it was first asked for. */
export function showPoster() {
  const poster = byId("poster");
  poster.addEventListener("load", () => { poster.hidden = poster.classList.contains("gone"); });
  poster.src = `poster.png${location.search}`;
}

function hidePoster() {
  const poster = byId("poster");
  if (poster.classList.contains("gone")) return;
  const next = (act) => frame.contentWindow.requestAnimationFrame(act);
  const go = () => { poster.classList.add("gone"); setTimeout(() => { poster.hidden = true; }, 400); };
  setTimeout(() => next(() => next(() => next(go))), 200); // what was sent has then been drawn
}

export const mark = (marks) => ask("POST", `${path}/mark`, { json: marks });
export const camera = () => ask("GET", `${path}/camera`);
const pick = (target) => ask("POST", `${path}/pick`, { json: target });

let running = null;
let waiting = null;

/** Draw what is asked for. While one request is drawn only the last of those that come is kept. */
export function show(asked, drawn, failed) {
  waiting = { asked, drawn, failed };
  running ??= drain();
  return running;
}

async function drain() {
  const busy = setTimeout(() => { byId("busy").hidden = false; }, 250);
  try {
    while (waiting) {
      const { asked, drawn, failed } = waiting;
      waiting = null;
      try {
        drawn(await ask("POST", `${path}/show`, { json: asked }));
        hidePoster();
      } catch (error) {
        failed(error);
      }
    }
  } finally {
    clearTimeout(busy);
    byId("busy").hidden = true;
    running = null;
  }
}

/** Watch the pointer over the canvas: `hovered(picked, x, y)` when it rests, `clicked(picked)`, `moved()` after a drag. */
export function watchPointer({ hovered, clicked, moved }) {
  const watch = () => {
    const inside = frame.contentWindow;
    let resting = null;
    let down = null;
    let asked = 0;
    const target = (event) => ({ u: clamp(event.clientX / inside.innerWidth), v: clamp(event.clientY / inside.innerHeight) });
    const look = async (event) => {
      const mine = ++asked;
      const picked = await pick(target(event)).catch(() => null);
      if (mine === asked) hovered(picked, event.clientX, event.clientY);
    };
    inside.addEventListener("pointermove", (event) => {
      clearTimeout(resting);
      asked++;
      hovered(null);
      if (event.buttons === 0 && event.pointerType !== "touch") resting = setTimeout(() => look(event), 120);
    });
    inside.addEventListener("pointerleave", () => { clearTimeout(resting); asked++; hovered(null); });
    inside.document.documentElement.addEventListener("mouseleave", () => { clearTimeout(resting); asked++; hovered(null); });
    inside.addEventListener("pointerdown", (event) => { down = [event.clientX, event.clientY]; }, true);
    inside.addEventListener("pointerup", async (event) => {
      const still = down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 5;
      down = null;
      if (still && event.button === 0) clicked(await pick({ ...target(event), surveys: true }).catch(() => null));
      else setTimeout(moved, 400);
    }, true);
    let turning = null;
    inside.addEventListener("wheel", () => { clearTimeout(turning); turning = setTimeout(moved, 500); }, { passive: true });
  };
  frame.addEventListener("load", watch);
  if (frame.contentDocument?.readyState === "complete" && frame.contentWindow.location.href !== "about:blank") watch();
}

const clamp = (value) => Math.min(1, Math.max(0, value));
