// Shapes as the paths of SVG. The world's y goes up, the screen's down: here it is turned over.

const SVG = "http://www.w3.org/2000/svg";

const made = (name, attributes, parent) => {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  parent.append(element);
  return element;
};

const at = (x, y) => `${x.toFixed(3)} ${(-y).toFixed(3)}`;
const dot = ({ x, y }) => `M${at(x, y)}h0`;
const line = (a, b) => `M${at(a.x, a.y)}L${at(b.x, b.y)}`;
const ring = ({ x, y }, radius) => outline({ x, y, xx: radius ** 2, xy: 0, yy: radius ** 2 }, 1);
const ahead = ({ x, y }, angle, length) =>
  ({ x: x + length * Math.cos(angle), y: y + length * Math.sin(angle) });

const polyline = (points) => {
  const known = points.filter(isKnown);
  return known.map((point, i) => (i ? "L" : "M") + at(point.x, point.y)).join("");
};

// The ellipse of a covariance, so many standard deviations wide.
const outline = ({ x, y, xx, xy, yy }, scale) => {
  if (![x, y, xx, xy, yy].every(Number.isFinite)) return "";
  const middle = (xx + yy) / 2, half = Math.hypot((xx - yy) / 2, xy);
  const major = scale * Math.sqrt(middle + half), minor = scale * Math.sqrt(Math.max(middle - half, 0));
  const angle = 0.5 * Math.atan2(2 * xy, xx - yy);
  const tip = ahead({ x: 0, y: 0 }, angle, major);
  const arc = `A${major.toFixed(4)} ${minor.toFixed(4)} ${((-angle * 180) / Math.PI).toFixed(2)} 0 0 `;
  const [one, other] = [at(x - tip.x, y - tip.y), at(x + tip.x, y + tip.y)];
  return `M${one}${arc}${other}${arc}${one}Z`;
};

// Where all stand whose way over them is so much longer: half the foci's distance along, and b across.
const excessPathEllipse = (vehicle, caller, excessPath) => {
  const [dx, dy] = [caller.x - vehicle.x, caller.y - vehicle.y];
  const b2 = (excessPath * (2 * Math.hypot(dx, dy) + excessPath)) / 4;
  const middle = { x: vehicle.x + dx / 2, y: vehicle.y + dy / 2 };
  return outline({ ...middle, xx: b2 + (dx * dx) / 4, xy: (dx * dy) / 4, yy: b2 + (dy * dy) / 4 }, 1);
};

const polygon = (points) => {
  const edge = polyline(points);
  return edge && `${edge}Z`;
};

const sector = (pose, width, length) => {
  const arc = Array.from({ length: 41 }, (_, i) =>
    ahead(pose, pose.heading + (i / 40 - 0.5) * width, length));
  return polygon([pose, ...arc]);
};

const DART = [[0.58, 0], [-0.42, 0.36], [-0.2, 0], [-0.42, -0.36]];
const dart = (pose, length) => polygon(DART.map(([along, across]) =>
  ahead(ahead(pose, pose.heading, length * along), pose.heading + Math.PI / 2, length * across)));

const star = (place, radius) => polygon(Array.from({ length: 10 }, (_, i) =>
  ahead(place, Math.PI / 2 + (i * Math.PI) / 5, i % 2 ? 0.42 * radius : radius)));

// The next round number below a length, or above it: 1, 2 or 5 times a power of ten.
const decadeOf = (length) => 10 ** Math.floor(Math.log10(length));
const roundBelow = (length) => [5, 2, 1].find((times) => times * decadeOf(length) <= length) * decadeOf(length);
const roundAbove = (length) => [1, 2, 5, 10].find((times) => times * decadeOf(length) >= length) * decadeOf(length);

// Numbers as a reader wants them.
const short = (number) => (Math.abs(number) < 1000 ? number.toFixed(2) : number.toPrecision(3));

const multiples = (low, high, step) => {
  const found = [];
  for (let i = Math.ceil(low / step); i * step <= high; i++) found.push(i * step);
  return found;
};
