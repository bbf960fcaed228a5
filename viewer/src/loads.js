// Loads of drones, as spheres, and the cables that they hang from.

import { CylinderGeometry, MeshLambertMaterial, SphereGeometry } from "three";
import { Marks } from "./arrows.js";
import { armOf, scratch } from "./flight.js";

const LOAD = "#b8860b", CABLE = "#4a4f55";
const RADIUS = 0.45, THICKNESS = 0.05; // of a load and of a cable, arms of the drone as it is drawn

/** Loads of one world. */
export class Loads {
  constructor(stage, world) {
    this.world = world;
    this.arms = world.kinds.map(armOf);
    const cable = new CylinderGeometry(1, 1, 1, 6).translate(0, 0.5, 0).rotateX(Math.PI / 2);
    this.loads = new Marks(stage, new SphereGeometry(1, 20, 14), new MeshLambertMaterial({ color: LOAD }), world.n);
    this.cables = new Marks(stage, cable, new MeshLambertMaterial({ color: CABLE }), world.n);
  }

  show(time, { hidden, ghost, offset }, fleet) {
    const { world } = this, visible = Boolean(world.loads) && !hidden && !ghost, [row, share] = world.at(time), { p, v, w } = scratch;
    for (let i = 0; i < world.n && visible; i++) {
      const there = world.position(row, share, i, p) && world.position(row, share, i, v, world.loads);
      const arm = this.arms[i] * fleet.scale(world.vehicle[i], p.add(offset)), cable = w.copy(v.add(offset)).sub(p);
      this.cables.arrow(i, p, cable, there ? cable.length() : 0, THICKNESS * arm);
      this.loads.sphere(i, v, there ? RADIUS * arm : 0);
    }
    this.loads.done(visible);
    this.cables.done(visible);
  }
}
