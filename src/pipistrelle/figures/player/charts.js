// What goes on over the whole mission, beneath a map: errors, and the lives of landmarks.

const LEVELS = 4;
const PLACED = LEVELS + 1;
const DURATION = mission.time[FRAMES - 1] || 1;

// A chart over time: a name, a number that changes, and a drawing that is stretched to its box.
const makeChart = (parent, { name, title, top, bottom = 0 }) => {
  const figure = document.createElement("figure");
  figure.className = `chart ${name}`;
  const caption = document.createElement("figcaption"), value = document.createElement("output");
  caption.append(title, " ", value);
  figure.append(caption);
  const box = document.createElement("div");
  box.className = "plot";
  figure.append(box);
  const svg = made("svg", { preserveAspectRatio: "none", "aria-hidden": "true" }, box);
  svg.setAttribute("viewBox", `0 ${-top} ${DURATION} ${top - bottom}`);
  const ticks = multiples(0, DURATION, roundBelow(DURATION / 3));
  const posts = ticks.map((t) => line({ x: t, y: bottom }, { x: t, y: top })).join("");
  made("path", { class: "grid", d: posts }, svg);
  const cursor = made("path", { class: "cursor" }, svg);
  parent.append(figure);
  return { svg, box, cursor, value, top, bottom };
};

const moveCursor = (chart, frame) => {
  const x = mission.time[frame];
  chart.svg.append(chart.cursor);
  chart.cursor.setAttribute("d", line({ x, y: chart.bottom }, { x, y: chart.top }));
};

const label = (chart, text, share) => {
  const word = document.createElement("span");
  word.className = share < 0.2 ? "tick high" : "tick";
  word.textContent = text;
  word.style.top = `${100 * share}%`;
  chart.box.append(word);
};

const overTime = (values) => Array.from(values, (y, frame) => ({ x: mission.time[frame], y }));

const band = (low, high) =>
  polygon([...overTime(high), ...overTime(low).reverse()].filter(isKnown));

// The largest number that a chart must show; a bound far above the errors is cut, as in figures.
const highest = (errors, bounds) => {
  const largest = (numbers) => numbers.filter(Number.isFinite).reduce((a, b) => Math.max(a, Math.abs(b)), 0);
  const error = largest(errors.flat()), bound = largest(bounds.flat());
  if (!error) return 1.05 * bound || 1;
  return Math.min(Math.max(1.05 * bound, 1.2 * error), 3 * error);
};

// Error and three standard deviations over time; without truth, the latter alone.
const errorChart = (parent, estimate, { name, title, unit, top, symmetric }) => {
  const errors = estimate.errors[name], bound = estimate.errors[`${name}Bound`];
  const revised = estimate.errors[`${name}Revised`];
  const known = errors.some(Number.isFinite);
  const words = known ? `${title} error and 3σ [${unit}]` : `3σ of ${title} [${unit}]`;
  const bottom = symmetric ? -top : 0;
  const chart = makeChart(parent, { name, title: words, top, bottom });
  const low = symmetric ? bound.map((one) => -one) : bound.map(() => 0);
  made("path", { class: "band", d: band(low, bound) }, chart.svg);
  if (symmetric) made("path", { class: "grid", d: line({ x: 0, y: 0 }, { x: DURATION, y: 0 }) }, chart.svg);
  made("path", { class: "line", d: polyline(overTime(errors)) }, chart.svg);
  if (revised) made("path", { class: "revised-line", d: polyline(overTime(revised)) }, chart.svg);
  const step = roundBelow(top);
  label(chart, `${Number(step.toPrecision(2))}`, (top - step) / (top - bottom));
  label(chart, "0", top / (top - bottom));
  return {
    ...chart,
    show: (frame) => {
      moveCursor(chart, frame);
      const said = [`${short(bound[frame])} ${unit}`];
      if (known) said[0] = `3σ ${said[0]}`;
      if (revised) said.unshift(`${short(revised[frame])} ${unit} as revised at the end (dotted)`);
      if (Number.isFinite(errors[frame])) said.unshift(`${short(errors[frame])} ${unit}`);
      chart.value.textContent = said.join(", ");
    },
  };
};

// What a landmark is at a frame: 0 nothing, 1 to LEVELS a ray, the surer the more, then PLACED.
const stateOf = (ray) => {
  if (!ray) return 0;
  if (ray.length === 1) return PLACED;
  return Math.min(LEVELS, 1 + Math.floor(LEVELS * heaviest(ray).weight));
};

// The landmarks in the order in which they are first heard, and their states at every frame.
const livesOf = (estimate) => {
  const lives = new Map();
  estimate.maps.forEach((map, frame) => {
    for (const [landmark, ray] of map) {
      if (!lives.has(landmark)) lives.set(landmark, new Array(FRAMES).fill(0));
      lives.get(landmark)[frame] = stateOf(ray);
    }
  });
  return lives;
};

// Stretches of one state as a path for each state.
const stretches = (lives) => {
  const d = new Array(PLACED + 1).fill("");
  [...lives.values()].forEach((states, row) => {
    let from = 0;
    for (let frame = 1; frame <= FRAMES; frame++) {
      if (frame < FRAMES && states[frame] === states[from]) continue;
      const end = mission.time[Math.min(frame, FRAMES - 1)];
      d[states[from]] += `M${mission.time[from].toFixed(2)} ${row + 0.5}H${end.toFixed(2)}`;
      from = frame;
    }
  });
  return d;
};

const lifeChart = (parent, estimate) => {
  const lives = livesOf(estimate), labels = [...lives.keys()], rows = Math.max(labels.length, 1);
  const chart = makeChart(parent, { name: "lives", title: "landmarks, in the order in which they were heard:", top: 0, bottom: -rows });
  chart.box.style.height = `${Math.max(5 * rows, 40)}px`;
  const chosen = made("path", { class: "chosen-row" }, chart.svg);
  stretches(lives).forEach((d, state) => {
    if (state) made("path", { class: state === PLACED ? "life placed-life" : `life life-${state}`, d }, chart.svg);
  });
  const show = (frame, landmark) => {
    moveCursor(chart, frame);
    const placed = placedOf(estimate.maps[frame]).length, rays = raysOf(estimate.maps[frame]).length;
    chart.value.textContent = `${placed} placed, ${rays} ${rays === 1 ? "ray" : "rays"}`;
    const row = labels.indexOf(landmark);
    chosen.setAttribute("d", row < 0 ? "" : `M0 ${row + 0.5}H${DURATION}`);
  };
  return { ...chart, show, landmarkAt: (share) => labels[Math.floor(share * rows)] };
};

const timeAxis = (parent) => {
  const axis = document.createElement("div");
  axis.className = "axis";
  axis.setAttribute("aria-hidden", "true");
  for (const t of multiples(0, DURATION, roundBelow(DURATION / 3))) {
    const word = document.createElement("span");
    word.textContent = `${Number(t.toPrecision(6))} s`;
    word.style.left = `${(100 * t) / DURATION}%`;
    axis.append(word);
  }
  parent.append(axis);
};
