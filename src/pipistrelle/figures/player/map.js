// The map of one estimate: what is true, what is heard and what is believed at a frame.

const LAYERS = [
  "grid", "beam", "member-1", "member-2", "member-3", "member-4", "member-5", "member-6", "spines",
  "pruned-3", "pruned-2", "pruned-1", "true-path", "places", "excess-paths", "excess-ways", "way", "bearings", "ranges", "tips",
  "ties", "placed", "dots", "excess-spot", "fresh", "caller-path", "callers", "believed-callers", "path", "revised", "cloud", "spread",
  "true-vehicle", "vehicle", "chosen",
];
const OPACITIES = 6;
const RECENT = 3;
const DART_PIXELS = 26, STAR_PIXELS = 8, PLACE_PIXELS = 4, TICK_PIXELS = 42;
const BEAM_SHARE = 0.25;

// An empty map: a path for each layer, lines of one width however large the map is shown.
const makeMap = (parent) => {
  const svg = made("svg", { class: "map", role: "img", preserveAspectRatio: "xMidYMid meet" }, parent);
  const layers = Object.fromEntries(LAYERS.map((name) => [name, made("path", { class: name }, svg)]));
  const texts = made("g", { class: "texts" }, svg);
  return { svg, layers, texts };
};

const wholeWorld = () => {
  const [[left, right], [bottom, top]] = mission.limits;
  return { left, right, bottom, top };
};

const around = ({ x, y }, reach) =>
  ({ left: x - reach, right: x + reach, bottom: y - reach, top: y + reach });

// Look at a part of the world, and at what is beside it where the map is wider or higher.
const look = (map, { left, right, bottom, top }) => {
  const { width, height } = map.svg.getBoundingClientRect();
  map.pixel = Math.max((right - left) / (width || 400), (top - bottom) / (height || 400));
  const wide = ((width || 400) * map.pixel) / 2, high = ((height || 400) * map.pixel) / 2;
  const x = (left + right) / 2, y = (bottom + top) / 2;
  map.box = { left: x - wide, right: x + wide, bottom: y - high, top: y + high };
  map.svg.setAttribute("viewBox", `${x - wide} ${-y - high} ${2 * wide} ${2 * high}`);
};

const drawMap = (map, estimate, frame, chosen) => {
  map.names = callerNames(map, estimate, frame);
  const pose = poseOf(estimate.pose, frame), believed = estimate.maps[frame];
  const d = {};
  drawGrid(map, d);
  drawTruth(map, d, frame);
  drawHeard(d, estimate, frame, pose, map.pixel);
  drawRays(d, estimate, frame, believed);
  drawPlaced(map, d, estimate, frame, believed);
  drawCallers(map, d, estimate, frame);
  drawExcessPaths(d, estimate, frame, pose, believed, chosen);
  drawVehicle(map, d, estimate, frame, pose);
  drawChosen(map, d, estimate, frame, believed, chosen);
  for (const name of LAYERS) map.layers[name].setAttribute("d", d[name] || "");
};

const drawGrid = (map, d) => {
  const { left, right, bottom, top } = map.box, [x0, y0] = mission.origin;
  const step = roundAbove(Math.max(Math.min(right - left, top - bottom) / 6, TICK_PIXELS * map.pixel));
  const xs = multiples(left + x0, right + x0, step), ys = multiples(bottom + y0, top + y0, step);
  d.grid = xs.map((x) => line({ x: x - x0, y: bottom }, { x: x - x0, y: top })).join("")
    + ys.map((y) => line({ x: left, y: y - y0 }, { x: right, y: y - y0 })).join("");
  const edge = 4 * map.pixel, words = [];
  const digits = Math.max(0, -Math.floor(Math.log10(step)));
  for (const x of xs) words.push([x.toFixed(digits), x - x0 + edge, bottom + edge]);
  for (const y of ys.slice(1)) words.push([y.toFixed(digits), left + edge, y - y0 + edge]);
  words.push(...map.names);
  writeWords(map, words);
};

// By where they are, or, where nobody knows that, by where they are believed to be.
const callerNames = (map, estimate, frame) =>
  mission.callers.map((caller, i) => ({ caller, spot: placeOf(caller, frame), belief: callerAt(estimate, i, frame) }))
    .map(({ caller, spot, belief }) => ({ caller, spot: isKnown(spot) ? spot : belief }))
    .filter(({ spot }) => isKnown(spot))
    .map(({ caller, spot: { x, y } }) => [caller.name, x + 9 * map.pixel, y + 7 * map.pixel, "name"]);

const writeWords = (map, words) => {
  map.texts.style.fontSize = `${11 * map.pixel}px`;
  while (map.texts.children.length > words.length) map.texts.lastChild.remove();
  while (map.texts.children.length < words.length) made("text", {}, map.texts);
  words.forEach(([word, x, y, kind = "tick"], i) => {
    const text = map.texts.children[i];
    text.textContent = word;
    text.setAttribute("class", kind);
    text.setAttribute("x", x);
    text.setAttribute("y", -y);
  });
};

const drawTruth = (map, d, frame) => {
  const radius = PLACE_PIXELS * map.pixel;
  d.places = [...trueLandmarks.values()].map((place) => ring(place, radius)).join("");
  const stars = [], ways = [];
  for (const caller of mission.callers) {
    stars.push(star(placeOf(caller, frame), STAR_PIXELS * map.pixel));
    if (caller.moves) ways.push(polyline(pointsOf(caller.place, 2, frame)));
  }
  d.callers = stars.join("");
  d["caller-path"] = ways.join("");
  if (!mission.truePose) return;
  const start = poseOf(mission.trueStart, 0), now = trueAt(frame);
  d["true-path"] = polyline([start, ...pointsOf(mission.truePose, 3, frame)]);
  if (isKnown(now)) d["true-vehicle"] = dart(now, DART_PIXELS * map.pixel);
};

const pointsOf = (flat, columns, frame) =>
  Array.from({ length: frame + 1 }, (_, i) => ({ x: flat[columns * i], y: flat[columns * i + 1] }));

// A range is solid, to where it ends; a bearing alone dashed, as far as the landmark may be.
const drawHeard = (d, estimate, frame, pose, pixel) => {
  if (!isKnown(pose)) return;
  const rays = heardAt(estimate, frame).map(({ bearing, range, ranged }) => {
    const length = ranged ? range : mission.farthest;
    const tip = ahead(pose, pose.heading + bearing, length);
    return { ranged, tip, base: ahead(pose, pose.heading + bearing, Math.min(14 * pixel, length)) };
  });
  const drawn = (kind) => rays.filter(({ ranged }) => ranged === kind);
  d.ranges = drawn(true).map(({ base, tip }) => line(base, tip)).join("");
  d.tips = drawn(true).map(({ tip }) => dot(tip)).join("");
  d.bearings = drawn(false).map(({ base, tip }) => line(base, tip)).join("");
};

// Members of rays, the likelier the darker, and what was pruned of them in the last frames.
const drawRays = (d, estimate, frame, believed) => {
  const rays = raysOf(believed), { ray: scale } = mission.scales;
  for (const member of rays.flat()) {
    const level = Math.min(OPACITIES, 1 + Math.floor(OPACITIES * member.weight));
    d[`member-${level}`] = (d[`member-${level}`] || "") + outline(member, scale);
  }
  d.spines = rays.map(polyline).join("");
  for (let age = 1; age <= RECENT && frame - age + 1 >= 0; age++) {
    const gone = rowsOf(estimate.pruned, frame - age + 1).map(memberOf);
    d[`pruned-${age}`] = gone.map((member) => outline(member, scale)).join("");
  }
};

const drawPlaced = (map, d, estimate, frame, believed) => {
  const placed = placedOf(believed);
  d.placed = placed.map((one) => outline(one, mission.scales.placed)).join("");
  d.dots = placed.filter(isKnown).map(dot).join("");
  d.ties = placed.filter((one) => isKnown(one) && trueLandmarks.has(one.landmark))
    .map((one) => line(one, trueLandmarks.get(one.landmark))).join("");
  const before = estimate.maps[Math.max(frame - RECENT, 0)];
  const fresh = placed.filter(({ landmark }) => (before.get(landmark) || []).length !== 1);
  d.fresh = fresh.filter(isKnown).map((one) => ring(one, 11 * map.pixel)).join("");
};

// A caller that stands is a landmark, in its ellipse already; one that moves is in its own.
const drawCallers = (map, d, estimate, frame) => {
  const believed = mission.callers.map(({ moves }, i) => ({ moves, ...callerAt(estimate, i, frame) })).filter(isKnown);
  d["believed-callers"] = believed.map((one) => star(one, 1.25 * STAR_PIXELS * map.pixel)
    + (one.moves ? outline(one, mission.scales.placed) : "")).join("");
};

// The excess paths of the chosen landmark, or of that which they resolve: ellipses about the vehicle and
// the caller, and the ways of which they tell.
const drawExcessPaths = (d, estimate, frame, pose, believed, chosen) => {
  if (!state.ellipses || !isKnown(pose)) return;
  const heard = excessPathsShown(estimate, frame, chosen), ellipses = [], ways = [], spots = [];
  for (const { landmark, caller, excessPath } of heard) {
    const from = callerAt(estimate, caller, frame), spot = heaviest(believed.get(landmark));
    ellipses.push(excessPathEllipse(pose, from, excessPath));
    ways.push(polyline([from, spot, pose]));
    spots.push(dot(spot));
  }
  d["excess-paths"] = ellipses.join("");
  d["excess-ways"] = ways.join("");
  d["excess-spot"] = spots.slice(0, 1).join("");
};

// The path told last, where the estimator revises it, and the frames since.
const pathSoFar = (estimate, frame) => {
  const told = estimate.revisedAt.findLastIndex((one) => one <= frame);
  const online = pointsOf(estimate.pose, 3, frame), start = poseOf(estimate.start, 0);
  if (told < 0) return { now: [start, ...online], online: [] };
  const revised = rowsOf(estimate.revised, told).map(({ numbers: [x, y] }) => ({ x, y }));
  return { now: [...revised, ...online.slice(estimate.revisedAt[told] + 1)], online: [start, ...online] };
};

const drawVehicle = (map, d, estimate, frame, pose) => {
  const { now, online } = pathSoFar(estimate, frame);
  d.path = polyline(now);
  d.revised = polyline(online);
  d.cloud = cloudAt(estimate, frame).filter(isKnown).map(dot).join("");
  if (!isKnown(pose)) return;
  const [xx, xy, yy] = estimate.spread.subarray(4 * frame, 4 * frame + 3);
  d.spread = outline({ ...pose, xx, xy, yy }, mission.scales.pose);
  d.vehicle = dart(pose, DART_PIXELS * map.pixel);
  const { left, right } = wholeWorld();
  if (estimate.strategy !== "passive" && mission.beamwidth) {
    d.beam = sector(pose, mission.beamwidth, BEAM_SHARE * (right - left));
  }
};

const cloudAt = ({ cloud }, frame) => {
  if (!cloud) return [];
  const particles = cloud.length / (3 * FRAMES);
  return Array.from({ length: particles }, (_, i) => poseOf(cloud, frame * particles + i));
};

// The chosen landmark, all guesses of it or a ring, and the way of the sound that tells of it.
const drawChosen = (map, d, estimate, frame, believed, chosen) => {
  const ray = believed.get(chosen), place = trueLandmarks.get(chosen), truth = trueAt(frame);
  const [spot] = ray || [place];
  if (ray && ray.length > 1) d.chosen = ray.map((one) => outline(one, mission.scales.ray)).join("");
  else if (spot && isKnown(spot)) d.chosen = ring(spot, 15 * map.pixel);
  const heard = heardAt(estimate, frame).find(({ landmark }) => landmark === chosen);
  if (!heard || !place || !truth || !isKnown(truth)) return;
  const callers = heard.ranged ? [] : mission.callers.filter(({ moves, label }) => !moves && label !== chosen);
  d.way = callers.map((caller) => placeOf(caller, frame)).filter(isKnown)
    .map((from) => line(from, place)).join("") + line(place, truth);
};
