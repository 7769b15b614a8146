// The panel: choices go to the scene, the scene's points come back as words.
(() => {
  const find = (selector) => document.querySelector(selector);
  const all = (selector) => [...document.querySelectorAll(selector)];
  const data = JSON.parse(find("#isodyn-data").textContent);
  const readout = new Readout(data);
  const chosen = { layer: "norm", height: data.height, view: "oblique", touched: false };

  const switched = (name) => find(`#isodyn-controls input[type=checkbox][value=${name}]`).checked;

  function showChoice() {
    const pictures = Object.entries(data.pictures);
    const hidden = pictures.flatMap(([layer, nodes]) => nodes.filter((_, k) => layer !== chosen.layer || k !== chosen.height));
    Scene.setVisible(hidden, false);
    Scene.setVisible([data.pictures[chosen.layer][chosen.height]], true);
    for (const [name, nodes] of Object.entries(data.extras))
      nodes.forEach((node, k) => Scene.setVisible([node], switched(name) && (nodes.length === 1 || k === chosen.height)));
    for (const legend of all(".isodyn-legend")) legend.hidden = legend.dataset.layer !== chosen.layer;
    for (const body of all("#isodyn-panel tbody")) body.hidden = Number(body.dataset.height) !== chosen.height;
    const name = data.layers[chosen.layer].label, height_m = data.heights_m[chosen.height].toFixed(2);
    Scene.canvas().setAttribute("role", "img");
    Scene.canvas().setAttribute("aria-label", `${name} at ${height_m} m, seen in space; its values are in the panel's table`);
    tellTyped();
  }

  async function words(x_m, y_m) {
    const { layer, height } = chosen;
    return readout.words(await readout.height(height), x_m, y_m, layer);
  }

  // The point that was typed or last read, so that nobody needs a pointer.
  async function tellTyped() {
    const [x, y] = ["#isodyn-x", "#isodyn-y"].map((id) => find(id).valueAsNumber);
    if (Number.isFinite(x) && Number.isFinite(y)) find("#isodyn-value").textContent = (await words(x, y)).slice(1).join("\n");
  }

  let asked = 0;
  async function tellPointed(event, keep) {
    const mine = ++asked, [ox, oy, oz] = data.local_origin_m, box = find("#isodyn-readout");
    const point = Scene.pointUnder(event, data.heights_m[chosen.height] - oz);
    if (point === null) return forget();
    const x_m = point[0] + ox, y_m = point[1] + oy, [place, ...lines] = await words(x_m, y_m);
    if (mine !== asked) return;
    if (keep) {
      find("#isodyn-x").value = x_m.toFixed(2);
      find("#isodyn-y").value = y_m.toFixed(2);
      tellTyped();
    }
    box.replaceChildren(...[place, ...lines].map((line) => Object.assign(document.createElement("div"), { textContent: line })));
    box.hidden = false;
    const left = event.clientX + 16 + box.offsetWidth > innerWidth ? event.clientX - 16 - box.offsetWidth : event.clientX + 16;
    const top = Math.min(event.clientY + 16, innerHeight - box.offsetHeight - 8);
    box.style.transform = `translate(${Math.max(left, 4)}px, ${Math.max(top, 4)}px)`;
  }

  function forget() {
    asked++;
    find("#isodyn-readout").hidden = true;
  }

  function listenToPointer() {
    const stage = find("#root");
    let pressed = null;
    stage.addEventListener("pointermove", (event) => {
      if (event.buttons) forget();
      else if (event.pointerType !== "touch") tellPointed(event, false);
    }, true);
    stage.addEventListener("pointerdown", (event) => {
      pressed = [event.clientX, event.clientY];
    }, true);
    // On the window: viser's controls capture the pointer while it is down.
    addEventListener("pointerup", (event) => {
      const moved = pressed && Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]);
      if (pressed && moved < 6) tellPointed(event, true);
      else if (pressed) chosen.touched = true;
      pressed = null;
    }, true);
    stage.addEventListener("wheel", () => { chosen.touched = true; forget(); }, { capture: true, passive: true });
    // A finger leaves with every tap; what it asked for stays until the next.
    stage.addEventListener("pointerleave", (event) => event.pointerType === "touch" || forget());
  }

  function listenToControls() {
    find("#isodyn-controls").addEventListener("change", (event) => {
      if (event.target.name === "isodyn-layer") chosen.layer = event.target.value;
      if (event.target.id === "isodyn-height") chosen.height = Number(event.target.value);
      showChoice();
    });
    for (const id of ["#isodyn-x", "#isodyn-y"]) find(id).addEventListener("input", tellTyped);
    for (const button of all("[data-view]"))
      button.addEventListener("click", () => {
        Object.assign(chosen, { view: button.dataset.view, touched: false });
        Views.show(chosen.view, data.box_m, !matchMedia("(prefers-reduced-motion: reduce)").matches);
      });
  }

  function listenToCollapse() {
    const button = find("#isodyn-collapse");
    button.addEventListener("click", () => {
      const open = document.documentElement.classList.toggle("isodyn-collapsed") === false;
      button.setAttribute("aria-expanded", String(open));
      button.textContent = open ? "Hide panel" : "Show panel";
    });
  }

  async function start() {
    listenToCollapse();
    const note = find("#isodyn-note");
    await Scene.ready(() => { note.hidden = false; });
    note.hidden = true;
    document.documentElement.classList.add("isodyn-steered");
    find("#isodyn-controls").disabled = false;
    listenToControls();
    listenToPointer();
    Views.show(chosen.view, data.box_m, false);
    new ResizeObserver(() => chosen.touched || Views.show(chosen.view, data.box_m, false)).observe(find("#root"));
    showChoice();
    readout.height(chosen.height);
  }

  start();
})();
