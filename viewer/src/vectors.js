// Vectors along the paths, such as the derivative of a cost with respect to the commands: arrows, the longest of a fixed length.

import { MeshBasicMaterial } from "three";
import { arrowShape, Marks } from "./arrows.js";
import { scratch } from "./flight.js";
import { legible } from "./theme.js";

export const VECTOR = legible("#cc79a7");
const MOST = 50; // arrows of a path
const LONGEST = 0.35, WIDTH = 0.008; // of the radius of the flight

export class PathVectors {
  constructor(stage, world) {
    Object.assign(this, { stage, world, every: Math.max(1, Math.ceil(world.rows / MOST)) });
    this.count = Math.ceil(world.rows / this.every);
    this.longest = 0;
    for (let k = 0; k < world.arrows.length; k += 3) this.longest = Math.max(this.longest, Math.hypot(...world.arrows.subarray(k, k + 3)) || 0);
    this.marks = new Marks(stage, arrowShape(), new MeshBasicMaterial({ color: VECTOR }), this.count * world.n);
  }

  show({ hidden, ghost, offset }) {
    const visible = !hidden && !ghost, { world, stage } = this, { p, v } = scratch;
    for (let k = 0; k < this.count && visible; k++)
      for (let i = 0; i < world.n; i++) {
        const row = k * this.every, there = world.position(row, 0, i, p);
        v.fromArray(world.arrows, 3 * (row * world.n + i));
        const length = there ? (LONGEST * stage.radius * v.length()) / this.longest : 0;
        this.marks.arrow(k * world.n + i, p.add(offset), v, length, WIDTH * stage.radius);
      }
    this.marks.done(visible);
  }
}
