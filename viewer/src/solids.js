// Obstacles of a scene as instances of unit shapes.

import {
  BoxGeometry, CapsuleGeometry, Color, CylinderGeometry, Group, InstancedMesh, Matrix4, Quaternion, SphereGeometry, SRGBColorSpace, Vector3,
} from "three";
import { materialOf } from "./materials.js";

export const BEFORE_DRONES = -1; // obstacles are drawn first, then what of a drone is behind them

const SHAPES = {
  Box: () => new BoxGeometry(1, 1, 1),
  Sphere: () => new SphereGeometry(1, 32, 20),
  Cylinder: () => new CylinderGeometry(1, 1, 1, 28).rotateX(Math.PI / 2),
  Capsule: ({ radius, height }) => new CapsuleGeometry(radius, height, 8, 24).rotateX(Math.PI / 2),
};

/** A group with all obstacles of a scene. */
export function solids(scene) {
  const alike = new Map();
  for (const solid of scene.obstacles) {
    const key = JSON.stringify([solid.kind, solid.color[3], ...(solid.kind === "Capsule" ? [solid.radius, solid.height] : [])]);
    alike.set(key, [...(alike.get(key) ?? []), solid]);
  }
  const group = new Group();
  for (const solids of alike.values()) {
    const [{ kind, color }] = solids, mesh = new InstancedMesh(SHAPES[kind](solids[0]), materialOf(kind, color[3]), solids.length);
    mesh.renderOrder = 2 * BEFORE_DRONES;
    solids.forEach((solid, i) => {
      mesh.setMatrixAt(i, new Matrix4().compose(new Vector3(...solid.pos), new Quaternion(...solid.quat), new Vector3(...scale(solid))));
      mesh.setColorAt(i, new Color().setRGB(...solid.color.slice(0, 3), SRGBColorSpace));
    });
    group.add(mesh);
  }
  return group;
}

/** How large an obstacle is, in the lengths of its shape. */
function scale({ kind, size, radius, height }) {
  return { Box: size, Sphere: [radius, radius, radius], Cylinder: [radius, radius, height], Capsule: [1, 1, 1] }[kind];
}

/** Low and high corner of the box along the axes of the world that holds an obstacle, and half of its longest edge. */
export function extent({ kind, pos, quat, size, radius, height }) {
  const tall = { Sphere: radius, Cylinder: height / 2, Capsule: height / 2 + radius }[kind];
  const own = kind === "Box" ? size.map((x) => x / 2) : [radius, radius, tall];
  const axes = [0, 1, 2].map((k) => new Vector3().setComponent(k, own[k]).applyQuaternion(new Quaternion(...quat)));
  const half = [0, 1, 2].map((k) => axes.reduce((sum, axis) => sum + Math.abs(axis.getComponent(k)), 0));
  return { half: Math.max(...half), low: pos.map((x, k) => x - half[k]), high: pos.map((x, k) => x + half[k]) };
}
