// Arrows of the rotors' thrusts, of the resultant force and torque and of contact forces, and the marks of the targets.

import {
  ConeGeometry, CylinderGeometry, DynamicDrawUsage, InstancedMesh, Matrix4, MeshBasicMaterial, OctahedronGeometry, Quaternion, Color, RingGeometry,
  Vector3,
} from "three";
import { mergeGeometries } from "three/examples/jsm/utils/BufferGeometryUtils.js";
import { armOf, scratch } from "./flight.js";

const NOWHERE = new Matrix4().makeScale(0, 0, 0);
const UP = new Vector3(0, 0, 1);
export const THRUST = "#e69f00", FORCE = "#d55e00", TORQUE = "#0072b2", CONTACT = "#009e73";
const THRUST_ARMS = 1.6; // length of the arrow of a rotor that carries its quarter of the weight, arms
const FORCE_ARMS = 3; // of a resultant or contact force that equals the weight
const TORQUE_ARMS = 3; // of a resultant torque of a hundredth of weight times arm
const TARGET_ARMS = 0.55; // half the height of the mark of a target, as large as its drone would be drawn there
const PAD_ARMS = 2.5; // radius of the ring on the ground about a target that is not higher than an arm
const BEHIND = { transparent: true, opacity: 0.3, depthTest: false, depthWrite: false };
const ON_GROUND = { polygonOffset: true, polygonOffsetFactor: -2, polygonOffsetUnits: -4 };

/** Instances that are set anew in every frame. */
export class Marks {
  constructor(stage, geometry, material, capacity) {
    this.mesh = new InstancedMesh(geometry, material, capacity);
    this.mesh.instanceMatrix.setUsage(DynamicDrawUsage);
    this.mesh.frustumCulled = false;
    this.mesh.visible = false;
    stage.scene.add(this.mesh);
    this.matrix = new Matrix4();
    this.turn = new Quaternion();
    this.size = new Vector3();
    this.along = new Vector3();
  }

  /** An arrow from a point along a vector, of this length and width, m. */
  arrow(k, from, vector, length, width) {
    if (!(length > 1e-6) || !Number.isFinite(length)) return this.mesh.setMatrixAt(k, NOWHERE);
    this.turn.setFromUnitVectors(UP, this.along.copy(vector).normalize());
    this.mesh.setMatrixAt(k, this.matrix.compose(from, this.turn, this.size.set(width, width, length)));
  }

  /** A sphere about a point, of this radius, m. */
  sphere(k, center, radius) {
    this.mesh.setMatrixAt(k, this.matrix.compose(center, this.turn.identity(), this.size.setScalar(radius)));
  }

  done(visible) {
    this.mesh.visible = visible;
    if (visible) this.mesh.instanceMatrix.needsUpdate = true;
  }
}

export function arrowShape() {
  const shaft = new CylinderGeometry(0.35, 0.35, 0.75, 8).translate(0, 0.375, 0);
  const head = new ConeGeometry(1, 0.3, 12).translate(0, 0.85, 0);
  return mergeGeometries([shaft, head]).rotateX(Math.PI / 2);
}

const arrowMaterial = (color) => new MeshBasicMaterial({ color });

/** Arrows and targets of one world. */
export class Arrows {
  constructor(stage, world, colors) {
    this.stage = stage;
    this.world = world;
    this.arms = world.kinds.map(armOf);
    this.thrust = new Marks(stage, arrowShape(), arrowMaterial(THRUST), 4 * world.n);
    this.force = new Marks(stage, arrowShape(), arrowMaterial(FORCE), world.n);
    this.torque = new Marks(stage, arrowShape(), arrowMaterial(TORQUE), world.n);
    this.contact = new Marks(stage, arrowShape(), arrowMaterial(CONTACT), world.n);
    this.targets = new Marks(stage, new OctahedronGeometry(1), new MeshBasicMaterial({ wireframe: true }), world.n);
    this.insides = new Marks(stage, new OctahedronGeometry(1), new MeshBasicMaterial(BEHIND), world.n); // also seen behind obstacles
    this.pads = new Marks(stage, new RingGeometry(0.8, 1, 48), new MeshBasicMaterial(ON_GROUND), world.n);
    for (const { mesh } of [this.targets, this.insides, this.pads]) world.labels.forEach((_, i) => mesh.setColorAt(i, new Color(colors(i))));
  }

  show(time, shown, { hidden, ghost, offset }, fleet) {
    const { world } = this, [row, share] = world.at(time), { p, v, w, q, r } = scratch;
    const thrust = shown.thrust && !hidden && !ghost, wrench = shown.wrench && !hidden && !ghost;
    const targets = shown.targets && !hidden && world.targets !== null;
    for (let i = 0; i < world.n && (thrust || wrench || targets); i++) {
      const there = world.position(row, share, i, p);
      p.add(offset);
      const kind = world.kinds[i], scale = fleet.scale(world.vehicle[i], p), arm = scale * this.arms[i], weight = kind.mass * kind.gravity;
      world.attitude(row, share, i, q);
      if (thrust)
        for (let k = 0; k < 4; k++) {
          const force = kind.kf * world.speed(row, i, k) ** 2;
          v.fromArray(kind.rotor_pos[k]).multiplyScalar(scale).applyQuaternion(q).add(p);
          w.set(0, 0, 1).applyQuaternion(q);
          this.thrust.arrow(4 * i + k, v, w, there ? (THRUST_ARMS * arm * force) / (weight / 4) : 0, 0.09 * arm);
        }
      if (wrench) {
        world.force(row, i, v);
        this.force.arrow(i, p, v, there ? (FORCE_ARMS * arm * v.length()) / weight : 0, 0.13 * arm);
        if (world.contacts) v.fromArray(world.contacts, 3 * (row * world.n + i));
        else v.set(0, 0, 0);
        this.contact.arrow(i, p, v, there ? (FORCE_ARMS * arm * v.length()) / weight : 0, 0.13 * arm);
        world.torque(row, i, w).applyQuaternion(q);
        this.torque.arrow(i, p, w, there ? (TORQUE_ARMS * arm * w.length()) / (0.01 * weight * this.arms[i]) : 0, 0.13 * arm);
      }
      if (targets) {
        const known = world.target(row, i, v), low = known && this.stage.hasGround && Math.abs(v.z) < this.arms[i];
        const drawn = this.arms[i] * fleet.scale(world.vehicle[i], v.add(offset)) * (ghost ? 0.6 : 1); // arm of a drone there
        const size = TARGET_ARMS * drawn, pad = PAD_ARMS * drawn;
        const matrix = known ? this.targets.matrix.compose(v, r.identity(), w.set(size, size, size)) : NOWHERE;
        for (const { mesh } of [this.targets, this.insides]) mesh.setMatrixAt(i, matrix);
        this.pads.mesh.setMatrixAt(i, low ? this.pads.matrix.compose(v.setZ(offset.z), r.identity(), w.set(pad, pad, 1)) : NOWHERE);
      }
    }
    this.thrust.done(thrust);
    this.force.done(wrench);
    this.torque.done(wrench);
    this.contact.done(wrench);
    this.targets.done(targets);
    this.insides.done(targets);
    this.pads.done(targets);
  }
}
