// The player: which estimates are shown, which frame, how fast, and what keys and fingers do.

const state = { frame: 0, clock: 0, playing: false, speed: 1, shown: [], chosen: null, ellipses: true };
const control = Object.fromEntries(
  ["play", "back", "on", "slider", "clock", "speed", "stage"].map((id) => [id, document.getElementById(id)]),
);
const SPEEDS = [1, 2, 5, 10, 20, 50, 100];
const VIEWING = 25; // seconds that a mission lasts at the speed chosen first
const NEAR_PIXELS = 22;
let panels = [];

// One estimate: its name, its map, the vehicle from near, its charts.
const makePanel = (index, place) => {
  const estimate = mission.estimates[index];
  const section = document.createElement("section");
  section.className = `panel c-${estimate.role}`;
  section.dataset.estimate = estimate.name;
  control.stage.append(section);
  const part = (name) => {
    const div = document.createElement("div");
    div.className = name;
    section.append(div);
    return div;
  };
  makeHead(part("head"), index, place, estimate);
  const map = makeMap(part("world"));
  const side = part("side");
  const told = document.createElement("div");
  told.className = "told";
  const near = makeMap(side);
  near.svg.classList.add("near");
  side.append(told);
  const below = part("below"), charts = makeCharts(below, estimate);
  map.svg.addEventListener("click", (event) => choose(landmarkNear(map, estimate, event)));
  return { estimate, section, map, near, told, charts };
};

const makeHead = (head, index, place, estimate) => {
  const select = document.createElement("select");
  select.setAttribute("aria-label", place ? "The estimate beside it" : "The estimate");
  mission.estimates.forEach(({ name }, i) => select.add(new Option(name, i, false, i === index)));
  if (mission.estimates.length > 1) select.add(new Option("nothing", -1));
  select.disabled = mission.estimates.length === 1;
  select.addEventListener("change", () => replace(place, Number(select.value)));
  const outcome = document.createElement("p");
  outcome.textContent = estimate.outcome;
  head.append(select, outcome);
};

const makeCharts = (below, estimate) => {
  const shown = state.shown.map((i) => mission.estimates[i].errors);
  const top = (name) => highest(shown.map((one) => one[name]), shown.map((one) => one[`${name}Bound`]));
  const charts = [
    errorChart(below, estimate, { name: "position", title: "position", unit: "m", top: top("position") }),
    errorChart(below, estimate, { name: "heading", title: "heading", unit: "°", top: top("heading"), symmetric: true }),
    lifeChart(below, estimate),
  ];
  timeAxis(below);
  charts.forEach((chart) => listen(chart));
  return charts;
};

// A finger or a mouse on a chart goes to that time, on a landmark's life to that landmark.
const listen = (chart) => {
  const go = (event) => {
    const { left, top, width, height } = chart.box.getBoundingClientRect();
    seek(frameAt(((event.clientX - left) / width) * DURATION));
    if (chart.landmarkAt && event.type === "click") choose(chart.landmarkAt((event.clientY - top) / height));
  };
  chart.box.addEventListener("click", go);
  chart.box.addEventListener("pointermove", (event) => { if (event.buttons) go(event); });
};

// The last frame that is not after a time.
const frameAt = (time) => {
  let low = 0, high = FRAMES - 1;
  while (low < high) {
    const middle = Math.ceil((low + high) / 2);
    if (mission.time[middle] <= time + 1e-6) low = middle; else high = middle - 1;
  }
  return low;
};

// How far the view from near reaches: most of three standard deviations fit.
const reachOf = (estimates) => {
  const bounds = estimates.flatMap(({ errors }) => errors.positionBound.filter(Number.isFinite));
  bounds.sort((a, b) => a - b);
  const usual = bounds[Math.floor(0.75 * bounds.length)] || 1;
  const { left, right } = wholeWorld();
  return Math.min(Math.max(1.1 * usual, 0.3), (right - left) / 4);
};

const landmarkNear = ({ svg, pixel }, estimate, event) => {
  const { x, y } = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
  let best = null, least = NEAR_PIXELS * pixel;
  const consider = (landmark, spot) => {
    const away = Math.hypot(spot.x - x, -spot.y - y);
    if (away < least) [best, least] = [landmark, away];
  };
  for (const ray of estimate.maps[state.frame].values()) ray.forEach((one) => consider(one.landmark, one));
  for (const [landmark, place] of trueLandmarks) consider(landmark, place);
  return best;
};

const choose = (landmark) => {
  state.chosen = landmark === state.chosen ? null : landmark;
  draw();
};

const apart = (one, other) => `${short(Math.hypot(one.x - other.x, one.y - other.y))} m`;

// What is to be said of the chosen landmark: not heard, a ray, or placed.
const storyOf = ({ maps }, frame, landmark) => {
  const name = nameOf(landmark), ray = maps[frame].get(landmark), place = trueLandmarks.get(landmark);
  const title = name[0].toUpperCase() + name.slice(1);
  if (!ray) return `${title}: ${maps.some((map) => map.has(landmark)) ? "not heard yet" : "never heard"}.`;
  const best = heaviest(ray), off = place ? `, ${apart(best, place)} from where it is` : "";
  if (ray.length > 1 && best.weight < 0.5) return `${title}: a ray of ${ray.length}, undecided.`;
  if (ray.length > 1) {
    return `${title}: a ray of ${ray.length}, the likeliest ${Math.min(99, Math.round(100 * best.weight))} %${off}.`;
  }
  let since = frame;
  while (since && (maps[since - 1].get(landmark) || []).length === 1) since--;
  return `${title}: placed since ${mission.time[since].toFixed(1)} s${off}.`;
};

const heardWords = (estimate, frame) => {
  const heard = heardAt(estimate, frame), ranged = heard.filter((one) => one.ranged).length;
  const alone = heard.length - ranged;
  if (!heard.length) return "Nothing heard.";
  const parts = [];
  if (ranged) parts.push(`${ranged} with ${ranged === 1 ? "its range" : "their ranges"}`);
  if (alone) parts.push(`${alone} by bearing only`);
  return `Heard: ${parts.join(", ")}.`;
};

const tell = (panel) => {
  const words = [heardWords(panel.estimate, state.frame)];
  if (state.chosen !== null) words.push(storyOf(panel.estimate, state.frame, state.chosen));
  else words.push("Select a landmark on the map to follow it.");
  panel.told.replaceChildren(...words.map((word) => {
    const line = document.createElement("p");
    line.textContent = word;
    return line;
  }));
};

const draw = () => {
  const reach = reachOf(panels.map((panel) => panel.estimate));
  for (const panel of panels) {
    const pose = poseOf(panel.estimate.pose, state.frame);
    look(panel.map, wholeWorld());
    drawMap(panel.map, panel.estimate, state.frame, state.chosen);
    if (isKnown(pose)) {
      look(panel.near, around(pose, reach));
      drawMap(panel.near, panel.estimate, state.frame, state.chosen);
    }
    panel.section.dataset.x = pose.x;
    panel.section.dataset.y = pose.y;
    panel.charts.forEach((chart) => chart.show(state.frame, state.chosen));
    tell(panel);
  }
  const time = `${mission.time[state.frame].toFixed(1)} s`, number = `${state.frame + 1} of ${FRAMES}`;
  control.clock.textContent = `${time} · ${number}`;
  control.slider.value = state.frame;
  control.slider.setAttribute("aria-valuetext", `${time}, frame ${number}`);
};

const seek = (frame) => {
  state.frame = Math.min(Math.max(frame, 0), FRAMES - 1);
  state.clock = mission.time[state.frame];
  draw();
};

const pause = () => {
  state.playing = false;
  control.play.setAttribute("aria-label", "Play");
  control.play.classList.remove("playing");
};

const play = () => {
  if (state.frame === FRAMES - 1) seek(0);
  state.playing = true;
  control.play.setAttribute("aria-label", "Pause");
  control.play.classList.add("playing");
  let last = performance.now();
  const step = (now) => {
    if (!state.playing) return;
    state.clock += (Math.min(now - last, 200) / 1000) * state.speed;
    last = now;
    const frame = frameAt(state.clock);
    if (frame !== state.frame) {
      state.frame = frame;
      draw();
    }
    if (frame === FRAMES - 1) pause(); else requestAnimationFrame(step);
  };
  requestAnimationFrame(step);
};

const toggle = () => (state.playing ? pause() : play());
const step = (frames) => { pause(); seek(state.frame + frames); };

const ellipses = document.getElementById("ellipses"); // only where excess paths were heard
const toggleEllipses = () => {
  state.ellipses = !state.ellipses;
  ellipses.setAttribute("aria-pressed", state.ellipses);
  draw();
};

const KEYS = {
  " ": toggle,
  ArrowRight: ({ shiftKey }) => step(shiftKey ? 10 : 1),
  ArrowLeft: ({ shiftKey }) => step(shiftKey ? -10 : -1),
  Home: () => step(-FRAMES),
  End: () => step(FRAMES),
  Escape: () => choose(null),
  ...(ellipses && { e: toggleEllipses }),
};

const onKey = (event) => {
  const action = KEYS[event.key];
  const elsewhere = event.target.closest("select") || event.ctrlKey || event.metaKey || event.altKey;
  if (!action || elsewhere) return;
  event.preventDefault();
  action(event);
};

// Show another estimate in a place; nothing in the place of one of two leaves the other alone.
const replace = (place, index) => {
  if (index < 0 && state.shown.length > 1) state.shown.splice(place, 1);
  else if (index >= 0) state.shown[place] = index;
  show();
};

const addBeside = () => {
  const [first] = state.shown;
  state.shown.push(mission.estimates.findIndex((_, i) => i !== first));
  show();
};

const show = () => {
  control.stage.replaceChildren();
  control.stage.className = state.shown.length > 1 ? "two" : "alone";
  const { left, right, bottom, top } = wholeWorld();
  control.stage.style.setProperty("--aspect", (right - left) / (top - bottom));
  panels = state.shown.map(makePanel);
  document.getElementById("beside").hidden = state.shown.length > 1 || mission.estimates.length === 1;
  draw();
};

const start = () => {
  control.slider.max = FRAMES - 1;
  const fitting = SPEEDS.findLast((one) => one <= DURATION / VIEWING) || SPEEDS[0];
  for (const one of SPEEDS) control.speed.add(new Option(`${one}×`, one, false, one === fitting));
  state.speed = fitting;
  control.speed.addEventListener("change", () => { state.speed = Number(control.speed.value); });
  control.slider.addEventListener("input", () => { pause(); seek(Number(control.slider.value)); });
  control.play.addEventListener("click", toggle);
  control.back.addEventListener("click", () => step(-1));
  control.on.addEventListener("click", () => step(1));
  document.getElementById("beside").addEventListener("click", addBeside);
  if (ellipses) ellipses.addEventListener("click", toggleEllipses);
  document.addEventListener("keydown", onKey);
  new ResizeObserver(() => draw()).observe(control.stage);
  state.shown = mission.estimates.length > 1 ? firstPair() : [0];
  show();
};

// Side by side at first: with another's calls, and by its own alone, where there are both.
const firstPair = () => {
  const [both, own] = ["fused", "active"].map((strategy) =>
    mission.estimates.findIndex(({ name }) => name.startsWith(strategy)));
  return both >= 0 && own >= 0 ? [both, own] : [0, 1];
};

start();
