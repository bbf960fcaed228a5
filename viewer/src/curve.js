// The learning curve of a training.

import { short } from "./plots.js";

const WIDTH = 200, HEIGHT = 90, EDGE = 6;
const NAMESPACE = "http://www.w3.org/2000/svg";

function element(name, attributes) {
  const made = document.createElementNS(NAMESPACE, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

/** Draw a curve of points (update, value) into a figure, which is hidden where there are none; one point may be chosen. */
export function drawCurve(figure, curve, chosen) {
  figure.hidden = !curve?.points.length;
  if (figure.hidden) return;
  const { label, points, best } = curve, share = label === "success", text = (y) => (share ? `${Math.round(100 * y)} %` : short(y));
  const values = points.map(([, y]) => y), [last, value] = points[points.length - 1];
  const low = share ? 0 : Math.min(...values), high = share ? 1 : Math.max(...values, low + 1e-6);
  const place = ([x, y]) => [EDGE + ((WIDTH - 2 * EDGE) * x) / (last || 1), HEIGHT - EDGE - ((HEIGHT - 2 * EDGE) * (y - low)) / (high - low)];
  const places = points.map(place), picture = element("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img" });
  picture.setAttribute("aria-label", `Learning curve: ${label} ${text(value)} after update ${last}`);
  for (const y of [low, high]) {
    const [, at] = place([0, y]);
    picture.append(element("line", { x1: 0, x2: WIDTH, y1: at, y2: at, class: "level" }));
  }
  picture.append(element("polyline", { points: places.map((at) => at.join(",")).join(" ") }));
  places.forEach(([cx, cy], k) => {
    const kept = points[k][0] === best;
    const point = element("circle", { cx, cy, r: k === chosen ? 5 : 3, class: [k === chosen && "chosen", kept && "kept"].filter(Boolean).join(" ") });
    if (kept) point.append(Object.assign(element("title", {}), { textContent: "the policy that was kept" }));
    picture.append(point);
  });
  const caption = document.createElement("figcaption");
  caption.textContent = `${label}, ${text(low)} to ${text(high)}, by update ${last}`;
  figure.replaceChildren(picture, caption);
}
