// All drones of all worlds: for every kind of vehicle a mesh for each level of detail, and the same for ghosts.

import {
  Color, CustomBlending, DoubleSide, GreaterDepth, Matrix4, MeshBasicMaterial, MeshLambertMaterial, Quaternion, ShaderMaterial, Vector3,
} from "three";
import { Batch } from "./batch.js";
import { armOf, scratch } from "./flight.js";
import { BEFORE_DRONES } from "./solids.js";
import { coarse, discs, dot, fine, plain, shadow } from "./vehicle.js";

const SLOWED = 0.02; // rotors turn so much slower than they do, so that an eye can follow
const LEVELS = [ // of detail, for drones whose arm is at least so many pixels long, as they are drawn
  { pixels: 14, geometry: fine, Material: MeshLambertMaterial, discs: true },
  { pixels: 9, geometry: plain, Material: MeshLambertMaterial, discs: true },
  { pixels: 3.5, geometry: coarse, Material: MeshBasicMaterial },
  { pixels: 0, geometry: dot, Material: MeshBasicMaterial },
];
const SMALLEST = 12, SMALLEST_ALONE = 40; // pixels, from rotor to rotor, of drones that are enlarged to be seen; alone or in a crowd
const BLURRED = 0.2; // of the speed of hovering: above it blades are a disc
const OPAQUE = 1.6; // of the speed of hovering, at which a disc is as dense as it gets
const GHOST_OPACITY = 0.28;
const BEHIND = { opacity: 0.6, blending: CustomBlending, depthFunc: GreaterDepth, depthWrite: false }; // an obstacle: the drone shines through
const SHADOW_DARKNESS = 0.5; // of a drone on the ground, of the light
const NOWHERE = new Matrix4().makeScale(0, 0, 0), LEVEL = new Quaternion(), WHITE = new Color(1, 1, 1);

export class Fleet {
  constructor(stage, worlds, vehicles, colors) {
    this.stage = stage;
    this.worlds = worlds;
    this.size = 1; // how many times as large as they are drones are drawn; 0: as large as it takes to see them
    this.colors = worlds.map((world, w) => world.labels.map((_, i) => new Color(colors(w, i))));
    this.angles = worlds.map((world) => new Float32Array(4 * world.n));
    this.slots = worlds.map((world) => new Array(world.n).fill(null));
    this.meshes = [];
    this.behind = []; // drawn between obstacles and drones
    const add = (mesh) => (this.stage.scene.add(mesh), this.meshes.push(mesh), mesh);
    this.shapes = vehicles.map((vehicle) => [{}, { transparent: true, opacity: GHOST_OPACITY, depthWrite: false }].map((look) => {
      const levels = LEVELS.map(({ geometry, Material }) => add(new Batch(geometry(vehicle), new Material({ vertexColors: true, side: DoubleSide, ...look }))));
      const blur = new MeshBasicMaterial({ vertexColors: true, side: DoubleSide, transparent: true, opacity: look.opacity ?? 1, depthWrite: false });
      if (!look.opacity) for (const level of levels) this.behind.push(level.in(new MeshBasicMaterial({ vertexColors: true, side: DoubleSide, ...BEHIND })));
      return { levels, discs: add(new Batch(discs(vehicle), blur)) };
    }));
    for (const mesh of this.behind) (mesh.renderOrder = BEFORE_DRONES), stage.scene.add(mesh);
    this.shadows = add(new Batch(shadow(), softShadow()));
    this.smallest = Math.max(SMALLEST, SMALLEST_ALONE / Math.sqrt(Math.max(...worlds.map(({ n }) => n))));
    this.arms = vehicles.map(armOf);
    this.hover = vehicles.map(({ mass, gravity, kf }) => Math.sqrt((mass * gravity) / 4 / kf)); // RPM
  }

  /** How many times as large as it is a drone at a point is drawn. */
  scale(kind, point) {
    if (this.size) return this.size;
    return Math.max(1, this.smallest / (2 * this.arms[kind] * this.stage.magnification(point)));
  }

  /**
   * Place all drones as they are at a time, `passed` seconds after the last; `layout` says where each world is drawn.
   * The drone `aboard` carries the camera, which does not see it: { world, drone }, or null.
   */
  place(time, passed, layout, aboard) {
    const { p, q } = scratch, { stage } = this, size = new Vector3(), matrix = new Matrix4();
    this.layout = layout;
    this.largest = 1;
    for (const mesh of this.meshes) mesh.count = 0;
    this.worlds.forEach((world, w) => {
      const [row, share] = world.at(time), { offset, ghost, hidden } = layout[w], slots = this.slots[w];
      slots.fill(null);
      for (let i = 0; i < world.n && !hidden; i++) {
        const there = world.position(row, share, i, p);
        world.attitude(row, share, i, q);
        p.add(offset);
        const kind = world.vehicle[i], scale = this.scale(kind, p), near = scale * this.arms[kind] * stage.magnification(p) * stage.detail;
        const shapes = this.shapes[kind][ghost ? 1 : 0], level = LEVELS.findIndex(({ pixels }) => !(near < pixels)), mesh = shapes.levels[level];
        const seen = there && Number.isFinite(q.w) && !(aboard && aboard.world === w && aboard.drone === i), place = mesh.add();
        if (seen) matrix.compose(p, q, size.setScalar(scale));
        const turns = LEVELS[level].discs && this.turn(world, row, i, passed);
        mesh.setMatrixAt(place, seen ? matrix : NOWHERE, turns?.blades);
        mesh.setColorAt(place, this.colors[w][i]);
        slots[i] = { mesh, place };
        if (!seen) continue;
        if (turns) this.blur(shapes.discs, matrix, turns, this.colors[w][i]);
        if (!ghost && stage.hasGround && p.z > 0) this.shade(p, scale * this.arms[kind], matrix);
        this.largest = Math.max(this.largest, scale);
      }
    });
    for (const mesh of this.meshes) mesh.update();
    if (!stage.hasObstacles) for (const mesh of this.behind) mesh.visible = false;
  }

  /** Turn the rotors of a drone: their angles, those of blades slow enough to be seen, and the density of the others' discs. */
  turn(world, row, i, passed) {
    const all = this.angles[world.index], hover = this.hover[world.vehicle[i]], turns = { angles: [], blades: [], density: [] };
    for (let k = 0; k < 4; k++) {
      const speed = world.speed(row, i, k), blurred = speed > BLURRED * hover;
      all[4 * i + k] = (all[4 * i + k] - world.kinds[i].rotor_spin[k] * speed * ((2 * Math.PI) / 60) * passed * SLOWED) % (2 * Math.PI);
      turns.angles.push(all[4 * i + k]);
      turns.blades.push(blurred ? NaN : all[4 * i + k]);
      turns.density.push(blurred ? Math.min(1, speed / hover / OPAQUE) : 0);
    }
    return turns;
  }

  blur(discs, matrix, { angles, density }, color) {
    const place = discs.add();
    discs.setMatrixAt(place, matrix, angles);
    discs.setTintAt(place, color, density);
  }

  /** A shadow under a drone, which is wider and lighter the higher it flies. */
  shade(point, arm, matrix) {
    const height = point.z / this.stage.radius, place = this.shadows.add(), radius = arm * (2 + height);
    matrix.compose(scratch.v.set(point.x, point.y, 0), LEVEL, scratch.w.setScalar(radius));
    this.shadows.setMatrixAt(place, matrix);
    this.shadows.setTintAt(place, WHITE, [SHADOW_DARKNESS / (1 + height)]);
  }

  /** Positions as the scene has them: read back from the matrices of the meshes, m, one row per drone of a world. */
  positions(w) {
    const matrix = new Matrix4(), p = new Vector3();
    return this.slots[w].map((slot) => {
      if (slot === null) return null;
      slot.mesh.getMatrixAt(slot.place, matrix);
      return p.setFromMatrixPosition(matrix).sub(this.layout[w].offset).toArray();
    });
  }
}

/** Black, less towards the edge; red and green are the place in a square from -1 to 1. */
function softShadow() {
  return new ShaderMaterial({
    vertexShader: "attribute vec4 color; varying vec4 at; void main() { at = color; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }",
    fragmentShader: "varying vec4 at; void main() { float clear = 1.0 - min(1.0, dot(at.xy, at.xy)); gl_FragColor = vec4(0.0, 0.0, 0.0, at.w * clear * clear); }",
    transparent: true, depthWrite: false, polygonOffset: true, polygonOffsetFactor: -2, polygonOffsetUnits: -4,
  });
}
