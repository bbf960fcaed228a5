// Trails as ribbons of constant width on the screen. Segments lie in the order of time, so that a window of time is a range.

import { BufferAttribute, BufferGeometry, Color, DoubleSide, Mesh, ShaderMaterial, Uint8BufferAttribute, Vector2, Vector3 } from "three";
import { scratch } from "./flight.js";

const NEVER = 1e30; // s
const MOST = 50000; // segments in one world

const VERTEX = `
attribute vec3 start; attribute vec3 stop; attribute vec2 corner; attribute vec2 times; attribute vec3 tint;
uniform vec2 resolution; uniform float width; uniform float now; uniform float span; uniform vec3 shift;
varying vec3 shade; varying float age;
void main() {
  float flown = clamp((now - times.x) / (times.y - times.x), 0.0, 1.0); // the last segment ends at the drone
  vec3 head = mix(start, stop, flown);
  vec4 a = projectionMatrix * viewMatrix * vec4(start + shift, 1.0), b = projectionMatrix * viewMatrix * vec4(head + shift, 1.0);
  float near = 0.001;
  if (a.w < near && b.w < near || times.x >= now) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
  if (a.w < near) a = mix(a, b, (near - a.w) / (b.w - a.w));
  if (b.w < near) b = mix(b, a, (near - b.w) / (a.w - b.w));
  vec2 along = (b.xy / b.w - a.xy / a.w) * resolution;
  along = length(along) > 1e-6 ? normalize(along) : vec2(1.0, 0.0);
  vec4 here = corner.y < 0.5 ? a : b;
  here.xy += vec2(-along.y, along.x) * corner.x * width / resolution * here.w;
  gl_Position = here;
  shade = tint;
  age = (now - mix(times.x, min(times.y, now), corner.y)) / span;
}`;
const FRAGMENT = `
uniform float opacity; varying vec3 shade; varying float age;
void main() {
  if (age > 1.0) discard;
  gl_FragColor = vec4(shade, opacity * (1.0 - 0.85 * clamp(age, 0.0, 1.0)));
  #include <colorspace_fragment>
}`;

/** The trails of one world, with room for as many rows as its arrays have. */
export class Trail {
  constructor(stage, world, color) {
    this.world = world;
    const room = world.t.length;
    this.every = Math.max(1, Math.ceil((world.n * room) / MOST));
    this.room = Math.floor((room - 1) / this.every);
    this.legs = 0;
    this.mesh = new Mesh(
      this.geometry(color),
      new ShaderMaterial({
        vertexShader: VERTEX, fragmentShader: FRAGMENT, transparent: true, depthWrite: false, side: DoubleSide,
        uniforms: {
          resolution: { value: new Vector2(1, 1) }, width: { value: 2 }, now: { value: 0 }, span: { value: 1 },
          shift: { value: new Vector3() }, opacity: { value: 1 },
        },
      }),
    );
    this.mesh.frustumCulled = false;
    this.mesh.renderOrder = 1;
    stage.scene.add(this.mesh);
    this.extend();
  }

  geometry(color) {
    const { world, room } = this, n = world.n, count = 4 * room * n;
    const start = new Float32Array(3 * count), stop = new Float32Array(3 * count), corner = new Float32Array(2 * count);
    const times = new Float32Array(2 * count), tint = new Uint8Array(3 * count), index = new Uint32Array(6 * room * n);
    const tints = world.labels.map((_, i) => new Color(color(i)).toArray().map((x) => Math.round(255 * x)));
    for (let leg = 0, vertex = 0, at = 0; leg < room; leg++)
      for (let i = 0; i < n; i++) {
        for (let c = 0; c < 4; c++, vertex++) {
          corner.set([c % 2 ? 1 : -1, c > 1 ? 1 : 0], 2 * vertex);
          tint.set(tints[i], 3 * vertex);
        }
        index.set([vertex - 4, vertex - 3, vertex - 2, vertex - 2, vertex - 3, vertex - 1], at);
        at += 6;
      }
    const geometry = new BufferGeometry();
    geometry.setIndex(new BufferAttribute(index, 1));
    geometry.setAttribute("position", new BufferAttribute(start, 3)); // three.js asks for it
    geometry.setAttribute("start", geometry.attributes.position);
    geometry.setAttribute("stop", new BufferAttribute(stop, 3));
    geometry.setAttribute("corner", new BufferAttribute(corner, 2));
    geometry.setAttribute("times", new BufferAttribute(times, 2));
    geometry.setAttribute("tint", new Uint8BufferAttribute(tint, 3, true));
    return geometry;
  }

  /** Draw the rows that have come since the last time, as far as there is room. */
  extend() {
    const { world, every, legs } = this, { start, stop, times } = this.mesh.geometry.attributes, { p, v } = scratch;
    this.legs = Math.min(this.room, Math.floor((world.rows - 1) / every));
    for (let leg = legs, vertex = 4 * legs * world.n; leg < this.legs; leg++)
      for (let i = 0; i < world.n; i++) {
        const row = leg * every;
        const there = world.position(row, 0, i, p) && world.position(row + every, 0, i, v);
        for (let c = 0; c < 4; c++, vertex++) {
          start.array.set(there ? [p.x, p.y, p.z] : [0, 0, 0], 3 * vertex);
          stop.array.set(there ? [v.x, v.y, v.z] : [0, 0, 0], 3 * vertex);
          times.array.set(there ? [world.t[row], world.t[row + every]] : [NEVER, 2 * NEVER], 2 * vertex);
        }
      }
    for (const attribute of [start, stop, times]) {
      attribute.addUpdateRange(4 * legs * world.n * attribute.itemSize, 4 * (this.legs - legs) * world.n * attribute.itemSize);
      attribute.needsUpdate = true;
    }
  }

  /** Draw the world anew, whose rows are others now. */
  restart() {
    this.legs = 0;
    this.extend();
  }

  /** Show the `span` seconds before a time; none if it is 0. */
  show(time, span, { hidden, ghost, offset }, stage) {
    const { uniforms } = this.mesh.material, { world, every } = this;
    this.mesh.visible = span > 0 && !hidden;
    if (!this.mesh.visible) return;
    uniforms.now.value = Math.min(time, world.end);
    uniforms.span.value = Number.isFinite(span) ? span : 1e9;
    uniforms.shift.value.copy(offset);
    uniforms.opacity.value = ghost ? 0.3 : 0.95;
    uniforms.width.value = world.n > 60 ? 1.2 : ghost ? 1.5 : 2.6;
    uniforms.resolution.value.copy(stage.pixels);
    const first = Number.isFinite(span) ? Math.floor(world.at(time - span)[0] / every) : 0;
    const last = Math.min(this.legs, Math.ceil(world.at(time)[0] / every) + 1);
    this.mesh.geometry.setDrawRange(6 * first * world.n, 6 * Math.max(0, last - first) * world.n);
  }
}
