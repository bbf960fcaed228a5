// The film of a training: a flight of every evaluated policy, one after the other, beside the learning curve.

import { drawCurve } from "./curve.js";

const find = (id) => document.getElementById(id);

export class History {
  /** `show` shows the world of a policy. */
  constructor({ label, points, best }, show) {
    this.curve = { label, best, points: points.map(([x, y]) => [x, y ?? 0]) };
    this.kept = Math.max(0, points.findIndex(([update]) => update === best));
    find("history").hidden = false;
    this.slider = find("update");
    this.slider.max = points.length - 1;
    this.slider.addEventListener("input", () => show(Number(this.slider.value)));
  }

  /** Mark a policy on the curve. */
  mark(world, name) {
    drawCurve(find("curve"), this.curve, world);
    this.slider.value = world;
    this.slider.setAttribute("aria-valuetext", name);
  }
}
