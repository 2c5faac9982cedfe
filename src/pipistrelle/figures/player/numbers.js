"use strict";
// The mission's numbers, as Python packed them, and how to ask for those of a frame.

const decoded = (text, Kind) =>
  new Kind(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);

// Unpacks arrays that stand as base64, however deep.
const unpacked = (value) => {
  if (Array.isArray(value)) return value.map(unpacked);
  if (value === null || typeof value !== "object") return value;
  if ("float32" in value) return decoded(value.float32, Float32Array);
  if ("int32" in value) return decoded(value.int32, Int32Array);
  return Object.fromEntries(Object.entries(value).map(([name, part]) => [name, unpacked(part)]));
};

const mission = unpacked(JSON.parse(document.getElementById("numbers").textContent));
const FRAMES = mission.time.length;

const poseOf = (flat, frame) =>
  ({ x: flat[3 * frame], y: flat[3 * frame + 1], heading: flat[3 * frame + 2] });
const isKnown = ({ x, y }) => Number.isFinite(x) && Number.isFinite(y);
const wrapped = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));

// The rows of a frame: each the landmark's label and its numbers.
const rowsOf = (rows, frame) => {
  const found = [], { landmark, numbers } = rows, columns = numbers.length / landmark.length;
  for (let i = rows.first[frame]; i < rows.first[frame + 1]; i++) {
    found.push({ landmark: landmark[i], numbers: numbers.subarray(columns * i, columns * (i + 1)) });
  }
  return found;
};

const memberOf = ({ landmark, numbers: [x, y, xx, xy, yy, weight] }) =>
  ({ landmark, x, y, xx, xy, yy, weight });

// The map at a frame: the members of each landmark by its label. One member: it is placed.
const mapAt = (estimate, frame) => {
  const found = new Map();
  for (const row of rowsOf(estimate.mapped, frame)) {
    if (!found.has(row.landmark)) found.set(row.landmark, []);
    found.get(row.landmark).push(memberOf(row));
  }
  return found;
};
const placedOf = (map) => [...map.values()].filter((ray) => ray.length === 1).map(([one]) => one);
const raysOf = (map) => [...map.values()].filter((ray) => ray.length > 1);
const heaviest = (ray) => ray.reduce((best, one) => (one.weight > best.weight ? one : best));

// What was heard at a frame: bearings [rad] and ranges [m], not a number where there is none.
const heardAt = (estimate, frame) =>
  rowsOf(estimate.heard, frame).map(({ landmark, numbers: [bearing, range] }) =>
    ({ landmark, bearing, range, ranged: Number.isFinite(range) }));

// Where a caller truly is at a frame.
const placeOf = ({ moves, place }, frame) => {
  const [x, y] = place.subarray(moves ? 2 * frame : 0);
  return { x, y };
};

// Where a caller is believed to be at a frame, by its place among the callers.
const callerAt = ({ callers }, caller, frame) => {
  const first = 5 * (frame * mission.callers.length + caller);
  const [x, y, xx, xy, yy] = callers ? callers.subarray(first, first + 5) : [];
  return { x, y, xx, xy, yy };
};

// The excess paths of a frame that are shown: two at most, of the chosen landmark or of one they resolve.
const excessPathsShown = ({ excessPaths, resolved }, frame, chosen) => {
  const heard = rowsOf(excessPaths, frame).map(({ landmark, numbers: [caller, excessPath] }) =>
    ({ landmark, caller, excessPath }));
  const own = heard.filter(({ landmark }) => landmark === chosen);
  return own.length ? own : heard.filter(({ landmark }) => landmark === resolved[frame]);
};

const trueLandmarks = new Map();
if (mission.landmarks) {
  const [labels, places] = mission.landmarks;
  labels.forEach((label, i) => {
    const [x, y] = places.subarray(2 * i, 2 * i + 2);
    trueLandmarks.set(label, { x, y });
  });
}

// Labels of an association that stand for no true landmark are below -1.
const nameOf = (label) => {
  if (label < -1) return `unmatched landmark ${-2 - label}`;
  const caller = mission.callers.find((one) => one.label === label && !one.moves);
  return caller ? `${caller.name} (landmark ${label})` : `landmark ${label}`;
};

const trueAt = (frame) => (mission.truePose ? poseOf(mission.truePose, frame) : null);

// Where the path is told anew at the end, its error there at every frame.
const revisedErrors = ({ revised, revisedAt }) => {
  const last = revisedAt.length - 1;
  if (last < 0 || revisedAt[last] !== FRAMES - 1 || !mission.truePose) return null;
  return rowsOf(revised, last).slice(1).map(({ numbers: [x, y] }, frame) =>
    Math.hypot(x - trueAt(frame).x, y - trueAt(frame).y));
};

// Errors of the pose at every frame, where the truth is known, and three standard deviations.
const errorsOf = (estimate) => {
  const found = { position: [], heading: [], positionBound: [], headingBound: [] };
  found.positionRevised = revisedErrors(estimate);
  for (let frame = 0; frame < FRAMES; frame++) {
    const pose = poseOf(estimate.pose, frame), truth = trueAt(frame);
    const [xx, , yy, turn] = estimate.spread.subarray(4 * frame, 4 * frame + 4);
    found.positionBound.push(mission.scales.pose * Math.sqrt(Math.max(xx + yy, 0)));
    found.headingBound.push((mission.scales.pose * Math.sqrt(Math.max(turn, 0)) * 180) / Math.PI);
    found.position.push(truth ? Math.hypot(pose.x - truth.x, pose.y - truth.y) : NaN);
    found.heading.push(truth ? (wrapped(pose.heading - truth.heading) * 180) / Math.PI : NaN);
  }
  return found;
};

for (const estimate of mission.estimates) {
  estimate.errors = errorsOf(estimate);
  estimate.maps = Array.from({ length: FRAMES }, (_, frame) => mapAt(estimate, frame));
}
