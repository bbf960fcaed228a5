// Downwash of drones: cones along their thrust axes, as wide as the jet where it has half the speed of its axis, and as
// dense as it is fast, by the law that jaxdrones/dynamics/interaction.py simulates (Bauersfeld et al., RA-L 2024).

import { BufferAttribute, BufferGeometry, DoubleSide, Matrix4, MeshBasicMaterial, Color, Vector3 } from "three";
import { Batch } from "./batch.js";
import { armOf, scratch } from "./flight.js";

export const JET = "#3f8fc4";
const SPEED = 10.11, ORIGIN = 5.817, WIDTH = 0.07668; // the constants of the law, in induced speeds and distances of two motors
const LENGTH = 18, RINGS = 12, SIDES = 14;
const DENSITY = 0.3; // opacity of the jet of a drone that hovers, one motor distance below it

/** Speed on the axis over the induced speed of the rotors, and width, at a distance below the rotors; lengths in motor distances. */
export function jet(z) {
  const onset = Math.min(1, Math.max(0, z));
  return { speed: (SPEED * onset ** 2 * (3 - 2 * onset)) / (Math.max(0, z) + ORIGIN), width: WIDTH * (Math.max(0, z) + ORIGIN) };
}

function cone() {
  const position = [], color = [], index = [], densest = jet(1).speed;
  for (let ring = 0; ring <= RINGS; ring++)
    for (let side = 0; side < SIDES; side++) {
      const z = LENGTH * (ring / RINGS) ** 2, { speed, width } = jet(z), angle = (2 * Math.PI * side) / SIDES, corner = ring * SIDES + side;
      position.push(width * Math.cos(angle), width * Math.sin(angle), -z);
      color.push(1, 1, 1, DENSITY * (speed / densest) * (1 - z / LENGTH));
      const next = ring * SIDES + ((side + 1) % SIDES);
      if (ring < RINGS) index.push(corner, next, corner + SIDES, corner + SIDES, next, next + SIDES);
    }
  const geometry = new BufferGeometry();
  geometry.setIndex(index);
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(position), 3));
  return geometry.setAttribute("color", new BufferAttribute(new Float32Array(color), 4));
}

export class Jets {
  constructor(stage, worlds) {
    this.worlds = worlds;
    this.mesh = new Batch(cone(), new MeshBasicMaterial({ vertexColors: true, transparent: true, side: DoubleSide, depthWrite: false }));
    this.color = new Color(JET);
    stage.scene.add(this.mesh);
  }

  show(time, shown, layout) {
    const { p, q } = scratch, { mesh } = this, matrix = new Matrix4(), size = new Vector3();
    mesh.count = 0;
    this.worlds.forEach((world, w) => {
      const [row, share] = world.at(time), { offset, ghost, hidden } = layout[w];
      for (let i = 0; i < world.n && shown && !hidden && !ghost; i++) {
        if (!world.position(row, share, i, p)) continue;
        const { mass, gravity, kf } = world.kinds[i], hover = Math.sqrt((mass * gravity) / 4 / kf);
        const speed = [0, 1, 2, 3].reduce((sum, k) => sum + Math.abs(world.speed(row, i, k)), 0) / 4 / hover, place = mesh.add();
        world.attitude(row, share, i, q);
        mesh.setMatrixAt(place, matrix.compose(p.add(offset), q, size.setScalar(Math.SQRT2 * armOf(world.kinds[i]))));
        mesh.setTintAt(place, this.color, [speed]);
      }
    });
    mesh.update();
  }
}
