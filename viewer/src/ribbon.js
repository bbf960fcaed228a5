// Error between two flights of the same drones: a ribbon from each drone of one to that of the other at the same time.

import { BufferAttribute, BufferGeometry, DoubleSide, Mesh, MeshBasicMaterial } from "three";
import { scratch } from "./flight.js";
import { legible } from "./theme.js";

export const ERROR = legible("#d55e00");
const OPACITY = 0.4;

/** Whether there are two flights with as many drones. */
export const comparable = (worlds) => worlds.length === 2 && worlds[0].n === worlds[1].n;

export class Ribbon {
  constructor(stage, worlds) {
    [this.world, this.other] = worlds;
    this.mesh = new Mesh(this.geometry(), new MeshBasicMaterial({ color: ERROR, transparent: true, opacity: OPACITY, side: DoubleSide, depthWrite: false }));
    this.mesh.frustumCulled = false;
    stage.scene.add(this.mesh);
  }

  /** Two points of every drone in every row of the first flight, as long as there is the second. */
  geometry() {
    const { world, other } = this, { p, v } = scratch, n = world.n, position = [], index = [];
    for (let row = 0; row < world.rows && world.t[row] <= other.end; row++) {
      const at = other.at(world.t[row]);
      for (let i = 0; i < n; i++) {
        const there = world.position(row, 0, i, p) && other.position(...at, i, v);
        position.push(p.x, p.y, p.z, v.x, v.y, v.z);
        const a = 2 * (row * n + i), b = a - 2 * n;
        if (row > 0) index.push(...(there ? [b, b + 1, a, a, b + 1, a + 1] : [a, a, a, a, a, a])); // nothing where one is nowhere
      }
    }
    const geometry = new BufferGeometry();
    geometry.setIndex(index);
    return geometry.setAttribute("position", new BufferAttribute(new Float32Array(position), 3));
  }

  /** Show the `span` seconds before a time. */
  show(time, span, visible) {
    this.mesh.visible = visible;
    if (!visible) return;
    const { world } = this, legs = (row) => 6 * row * world.n, [row, share] = world.at(time), last = row + Math.round(share);
    const first = Number.isFinite(span) ? world.at(time - span)[0] : 0;
    this.mesh.geometry.setDrawRange(legs(first), legs(last - first));
  }

  /** Distance between the two of a drone, m. */
  distance(time, i) {
    const { p, v } = scratch;
    this.world.position(...this.world.at(time), i, p);
    this.other.position(...this.other.at(time), i, v);
    return p.distanceTo(v);
  }
}
