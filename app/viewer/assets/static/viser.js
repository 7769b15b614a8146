// The only part that knows viser: how its scene is steered from outside. viser 1.1 leaves its state on `window` for its
// own browser tests: the queue of messages a server would send, the objects of the scene, the camera and its controls.
// tests/viewer/test_static_browser.py fails when that changes.
const Scene = (() => {
  const NODE_BEFORE_ANY = "/Ground"; // drawn last: once it is there, all the others are
  const PATIENCE_MS = 15000;
  const state = () => window.__viserMutable;

  function isReady() {
    const viser = state(), tree = window.__viserSceneTree;
    if (!viser || !tree || !Array.isArray(viser.messageQueue) || !viser.camera || !viser.cameraControl) return false;
    return Boolean(viser.nodeRefFromName[""] && viser.canvas && tree.getState()[NODE_BEFORE_ANY]);
  }

  // Resolves once the scene can be steered; calls `late` when that takes suspiciously long.
  function ready(late) {
    const warning = setTimeout(late, PATIENCE_MS);
    return new Promise((tell) => {
      const look = () => (isReady() ? tell() : setTimeout(look, 50));
      look();
    }).then(() => clearTimeout(warning));
  }

  function setVisible(names, visible) {
    for (const name of names)
      state().messageQueue.push({ type: "SetSceneNodeVisibilityMessage", name, visible, owner: "" });
    state().requestRender();
  }

  const vector = (x, y, z) => state().camera.position.clone().set(x, y, z);
  const toThree = (p) => vector(...p).applyMatrix4(state().nodeRefFromName[""].matrixWorld);

  function lookFrom(position, target, animated) {
    const p = toThree(position), t = toThree(target);
    state().cameraControl.setLookAt(p.x, p.y, p.z, t.x, t.y, t.z, animated);
    state().requestRender();
  }

  // Where the ray through a pixel meets the plane z = z_m: [x, y] in metres of the scene, or null.
  function pointUnder(event, z_m) {
    const viser = state(), box = viser.canvas.getBoundingClientRect();
    const right = (2 * (event.clientX - box.left)) / box.width - 1, up = 1 - (2 * (event.clientY - box.top)) / box.height;
    const toScene = viser.nodeRefFromName[""].matrixWorld.clone().invert();
    const from = vector(0, 0, 0).setFromMatrixPosition(viser.camera.matrixWorld).applyMatrix4(toScene);
    const through = vector(right, up, 0.5).unproject(viser.camera).applyMatrix4(toScene);
    const along = (z_m - from.z) / (through.z - from.z);
    return along > 0 ? [from.x + along * (through.x - from.x), from.y + along * (through.y - from.y)] : null;
  }

  const canvas = () => state().canvas;
  // Tangents of half the angles of view: [horizontal, vertical].
  function halfView() {
    const { fov } = state().camera, box = canvas().getBoundingClientRect();
    const tangent = Math.tan((fov * Math.PI) / 360);
    return [(tangent * box.width) / box.height, tangent];
  }

  return { ready, setVisible, lookFrom, pointUnder, canvas, halfView };
})();

// Where to stand so that a box fills the view: the direction stays, distance and target follow from the box.
const Views = (() => {
  const DIRECTIONS = { oblique: [-0.1, -0.75, 1], above: [0, -1e-3, 1] };
  const FILLED = 0.92; // of the view
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const plus = (a, s, b) => a.map((v, i) => v + s * b[i]);
  const unit = (a) => a.map((v) => v / Math.sqrt(dot(a, a)));
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

  function corners([low, high]) {
    return [0, 1, 2, 3, 4, 5, 6, 7].map((k) => [0, 1, 2].map((axis) => (k >> axis) & 1 ? high[axis] : low[axis]));
  }

  function fitted(direction, box, [wide, tall]) {
    const back = unit(direction), right = unit(cross([0, 0, 1], back)), up = cross(back, right);
    const points = corners(box);
    let target = box[0].map((v, i) => (v + box[1][i]) / 2), distance = 1;
    for (let round = 0; round < 6; round++) {
      const seen = points.map((p) => plus(p, -1, target)).map((p) => [dot(p, right), dot(p, up), dot(p, back)]);
      const reach = ([x, y, z]) => Math.max(Math.abs(x) / wide, Math.abs(y) / tall) / FILLED + z;
      distance = Math.max(2, ...seen.map(reach));
      const across = seen.map(([x, , z]) => x / (distance - z)), upward = seen.map(([, y, z]) => y / (distance - z));
      const middle = (values) => ((Math.min(...values) + Math.max(...values)) / 2) * distance;
      target = plus(plus(target, middle(across), right), middle(upward), up);
    }
    return [plus(target, distance, back), target];
  }

  function show(name, box, animated) {
    const [position, target] = fitted(DIRECTIONS[name], box, Scene.halfView());
    Scene.lookFrom(position, target, animated);
  }

  return { show };
})();
