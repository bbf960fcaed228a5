// All drones of all worlds: for every kind of vehicle a mesh for each level of detail, and the same for ghosts.

import {
  Color, DoubleSide, DynamicDrawUsage, InstancedBufferAttribute, InstancedMesh, Matrix4, MeshBasicMaterial, MeshLambertMaterial, Vector3,
} from "three";
import { Batch, sent } from "./batch.js";
import { armOf, scratch } from "./flight.js";
import { coarse, discs, dot, fine, plain } from "./vehicle.js";

const SLOWED = 0.02; // rotors turn so much slower than they do, so that an eye can follow
const LEVELS = [ // of detail, for drones whose arm is at least so many pixels long, as they are drawn
  { pixels: 14, geometry: fine, Material: MeshLambertMaterial },
  { pixels: 9, geometry: plain, Material: MeshLambertMaterial },
  { pixels: 3.5, geometry: coarse, Material: MeshBasicMaterial },
  { pixels: 0, geometry: dot, Material: MeshBasicMaterial },
];
const NOWHERE = new Matrix4().makeScale(0, 0, 0);
const GHOST_OPACITY = 0.28;

export class Fleet {
  constructor(stage, worlds, vehicles, colors) {
    this.stage = stage;
    this.worlds = worlds;
    this.scale = 1;
    this.colors = worlds.map((world, w) => world.labels.map((_, i) => new Color(colors(w, i))));
    this.angles = worlds.map((world) => new Float32Array(4 * world.n));
    this.slots = worlds.map((world) => new Array(world.n).fill(null));
    this.shapes = vehicles.map((vehicle, k) => {
      const count = worlds.reduce((sum, world) => sum + world.vehicle.filter((v) => v === k).length, 0);
      return [false, true].map((ghost) => LEVELS.map((level) => this.mesh(level, vehicle, count, ghost)));
    });
    this.arms = vehicles.map(armOf);
    this.meshes = this.shapes.flat(2);
  }

  mesh({ geometry: shape, Material }, vehicle, count, ghost) {
    const geometry = shape(vehicle), look = ghost ? { transparent: true, opacity: GHOST_OPACITY, depthWrite: false } : {};
    if (shape === coarse || shape === dot) {
      const batch = new Batch(geometry, new Material({ vertexColors: true, side: DoubleSide, ...look }), count);
      batch.castShadow = !ghost;
      this.stage.scene.add(batch);
      return batch;
    }
    geometry.setAttribute("spin", new InstancedBufferAttribute(new Float32Array(4 * count), 4).setUsage(DynamicDrawUsage));
    const mesh = new InstancedMesh(geometry, turning(new Material({ vertexColors: true, side: DoubleSide, ...look })), count);
    mesh.instanceMatrix.setUsage(DynamicDrawUsage);
    mesh.instanceColor = new InstancedBufferAttribute(new Float32Array(3 * count), 3).setUsage(DynamicDrawUsage);
    mesh.castShadow = !ghost;
    mesh.frustumCulled = false;
    this.stage.scene.add(mesh);
    if (shape === fine) {
      const look = { color: 0x445566, transparent: true, opacity: ghost ? 0.06 : 0.22, side: DoubleSide, depthWrite: false };
      mesh.discs = new InstancedMesh(discs(vehicle), new MeshBasicMaterial(look), count);
      mesh.discs.instanceMatrix = mesh.instanceMatrix;
      mesh.discs.frustumCulled = false;
      this.stage.scene.add(mesh.discs);
    }
    return mesh;
  }

  /**
   * Place all drones as they are at a time, `passed` seconds after the last; `layout` says where each world is drawn.
   * The drone `aboard` carries the camera, which does not see it: { world, drone }, or null.
   */
  place(time, passed, layout, aboard) {
    const { p, q } = scratch, { camera, canvas } = this.stage, size = new Vector3().setScalar(this.scale), matrix = new Matrix4();
    const pixels = (this.stage.detail * canvas.clientHeight) / 2 / Math.tan((camera.fov * Math.PI) / 360); // of 1 m at 1 m
    this.layout = layout;
    for (const mesh of this.meshes) mesh.count = 0;
    this.worlds.forEach((world, w) => {
      const [row, share] = world.at(time), angles = this.angles[w], { offset, ghost, hidden } = layout[w], slots = this.slots[w];
      slots.fill(null);
      for (let i = 0; i < world.n && !hidden; i++) {
        const there = world.position(row, share, i, p);
        world.attitude(row, share, i, q);
        p.add(offset);
        const kind = world.vehicle[i], near = (this.scale * this.arms[kind] * pixels) / p.distanceTo(camera.position);
        const mesh = this.shapes[kind][ghost ? 1 : 0][LEVELS.findIndex((level) => !(near < level.pixels))], place = mesh.count++;
        const seen = there && Number.isFinite(q.w) && !(aboard && aboard.world === w && aboard.drone === i);
        mesh.setMatrixAt(place, seen ? matrix.compose(p, q, size) : NOWHERE);
        mesh.setColorAt(place, this.colors[w][i]);
        const spin = world.kinds[i].rotor_spin, turned = mesh.geometry.attributes.spin?.array;
        for (let k = 0; k < 4 && turned; k++) {
          angles[4 * i + k] -= spin[k] * world.speed(row, i, k) * ((2 * Math.PI) / 60) * passed * SLOWED;
          turned[4 * place + k] = angles[4 * i + k] % (2 * Math.PI);
        }
        slots[i] = { mesh, place };
      }
    });
    for (const mesh of this.meshes) {
      if (mesh instanceof Batch) mesh.update();
      else for (const attribute of [mesh.instanceMatrix, mesh.instanceColor, mesh.geometry.attributes.spin]) sent(attribute, mesh.count);
      mesh.visible = mesh.count > 0;
      if (mesh.discs) [mesh.discs.count, mesh.discs.visible] = [mesh.count, mesh.visible];
    }
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

/** A material whose vertices turn about the hub of their rotor. */
function turning(material) {
  material.onBeforeCompile = (shader) => {
    shader.vertexShader = shader.vertexShader
      .replace("#include <common>", "#include <common>\nattribute float rotor;\nattribute vec2 hub;\nattribute vec4 spin;")
      .replace(
        "#include <begin_vertex>",
        `#include <begin_vertex>
        if (rotor > 0.5) {
          float angle = rotor < 1.5 ? spin.x : rotor < 2.5 ? spin.y : rotor < 3.5 ? spin.z : spin.w;
          vec2 arm = transformed.xy - hub;
          transformed.xy = hub + vec2(arm.x * cos(angle) - arm.y * sin(angle), arm.x * sin(angle) + arm.y * cos(angle));
        }`,
      );
  };
  return material;
}
