// What is drawn and said of tracks: nothing here asks the server or touches the page.

const [MOST_DRAWN, GAP_M, COURSE_M, PATH_S] = [20, 3, 0.7, 180];
const STATES = { searching: "warn", converged: "good", lost: "bad" };

export const kindOf = (estimate) => STATES[estimate.state] ?? "";
export const nameOf = (track) => track.name || `track ${track.id.slice(-6)}`;

/** How long ago, in words. */
export function ago(seconds) {
  if (seconds < 2) return "just now";
  if (seconds < 100) return `${Math.round(seconds)} s ago`;
  return `${Math.round(seconds / 60)} min ago`;
}

/** Where it is, in words and numbers. */
export function whereabouts({ estimate, path }) {
  if (!estimate.position_m) return "no place found yet";
  const [x, y] = estimate.position_m.map(fixed);
  if (estimate.state !== "converged") return `perhaps x ${x} m, y ${y} m (${Math.round(100 * shareOf(estimate))} %)`;
  const course = courseOf(estimate, path);
  return `x ${x} m, y ${y} m; within ${fixed(estimate.radius_95_m)} m with 95 %`
    + (course === null ? "" : `; heading ${Math.round((course * 180) / Math.PI + 360) % 360}°`);
}

/** Of the strongest place. */
const shareOf = (estimate) => estimate.modes[0]?.probability ?? 0;
const fixed = (value) => value.toFixed(2).replace("-", "−");

/** The path with what is new of it: settled places stay, of the others the latest holds; of the last minutes. */
export function extended(path, points) {
  const settled = [...path.filter((each) => each.settled), ...points.filter((each) => each.settled)];
  const all = [...settled, ...points.filter((each) => !each.settled)];
  const from = (all.at(-1)?.t_s ?? 0) - PATH_S;
  return all.filter((each) => each.t_s >= from);
}

/** What is to be drawn of tracks; where one is not converged, also the other places it may be at. */
export function marksOf(tracks) {
  const drawn = tracks.filter(({ estimate }) => estimate.position_m).slice(-MOST_DRAWN);
  return {
    of: "tracks",
    modes: drawn.flatMap(modesOf).slice(0, 64),
    ellipses: drawn.filter(({ estimate }) => estimate.state !== "lost").map(ellipseOf),
    paths: drawn.flatMap(piecesOf).slice(-64),
  };
}

const ellipseOf = ({ estimate: { floor_id, position_m, covariance_m2 } }) => ({ floor_id, position_m, covariance_m2 });

function modesOf({ track, estimate, path }) {
  const converged = estimate.state === "converged";
  const label = (converged ? nameOf(track) : `${nameOf(track)}: ${estimate.state}`).slice(0, 80);
  const first = {
    floor_id: estimate.floor_id, position_m: estimate.position_m, label, heading_rad: courseOf(estimate, path),
    probability: converged ? 1 : shareOf(estimate),
  };
  const others = estimate.modes.slice(1, 8).map(({ floor_id, position_m, probability }) => ({ floor_id, position_m, probability }));
  return converged ? [first] : [first, ...others];
}

/** Places along the way, the present one at last. What may still change is left out while several places fit. */
function wayOf(estimate, path) {
  const sure = path.filter((each) => each.settled || estimate.state === "converged");
  return estimate.state === "converged" ? [...sure, estimate] : sure;
}

/** Lines of a floor each, broken where it was lost and found elsewhere. */
function piecesOf({ estimate, path }) {
  const pieces = [];
  for (const { floor_id, position_m } of wayOf(estimate, path)) {
    const last = pieces.at(-1);
    if (last?.floor_id === floor_id && apart(last.points_m.at(-1), position_m) < GAP_M) last.points_m.push(position_m.map(rounded));
    else pieces.push({ floor_id, kind: "estimate", points_m: [position_m.map(rounded)] });
  }
  return pieces.filter((piece) => piece.points_m.length > 1);
}

/** The way it goes: from where it was a step or two before; null while it is not known. */
function courseOf(estimate, path) {
  if (estimate.state !== "converged") return null;
  const [x, y] = estimate.position_m;
  const before = path.findLast((each) => each.floor_id === estimate.floor_id && apart(each.position_m, [x, y]) > COURSE_M);
  return before ? Math.atan2(y - before.position_m[1], x - before.position_m[0]) : null;
}

const apart = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
const rounded = (value) => Number(value.toFixed(3));
