// Worlds in time: rows, interpolation, and what is computed from the logged states.

import { Quaternion, Vector3 } from "three";
import { extent } from "./solids.js";

const HUGE = 1e6; // m; a drone that is further away, or nowhere, is not shown
const SAMPLES = 3000; // positions that the camera is fitted to
const SIZES = { pos: 3, quat: 4, vel: 3, omega: 3, rpm: 4, targets: 3, target_vel: 3, loads: 3, contacts: 3 }; // numbers per drone and row

/** Largest horizontal distance of a rotor from the center of mass, m. */
export const armOf = (vehicle) => Math.max(...vehicle.rotor_pos.map(([x, y]) => Math.hypot(x, y)));

/** One world of n drones over K rows. */
export class World {
  constructor(entries, vehicles, index) {
    Object.assign(this, entries);
    this.index = index;
    this.n = this.labels.length;
    this.rows = this.t.length;
    this.end = this.t[this.rows - 1];
    this.kinds = this.vehicle.map((k) => vehicles[k]);
  }

  /** Make room for so many rows in all. */
  reserve(rows) {
    const longer = (array, size) => {
      const room = new Float32Array(size);
      room.set(array.subarray(0, Math.min(size, array.length)));
      return room;
    };
    if (rows <= this.t.length) return;
    this.t = longer(this.t, rows);
    for (const [name, size] of Object.entries(SIZES)) if (this[name]) this[name] = longer(this[name], size * this.n * rows);
  }

  /** Add rows at the end; what they lack is not a number. */
  append(more) {
    const count = more.t.length, first = this.rows;
    if (first + count > this.t.length) this.reserve(2 * (first + count));
    this.t.set(more.t, first);
    if (more.contacts && !this.contacts) this.contacts = new Float32Array(SIZES.contacts * this.n * this.t.length); // the first touch
    for (const [name, size] of Object.entries(SIZES)) {
      if (!this[name]) continue;
      const from = size * this.n * first;
      if (more[name]) this[name].set(more[name], from);
      else this[name].fill(NaN, from, from + size * this.n * count);
    }
    this.rows += count;
    this.end = this.t[this.rows - 1];
  }

  /** The rows that there are of `pos`, `targets` or `loads`. */
  known(name) {
    return this[name]?.subarray(0, SIZES[name] * this.n * this.rows) ?? [];
  }

  /** The row at or before a time, and how far the time is towards the next one (0 to 1). */
  at(time) {
    const t = this.t;
    if (time <= t[0]) return [0, 0];
    if (time >= this.end) return [this.rows - 1, 0];
    let low = 0, high = this.rows - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (t[middle] <= time) low = middle;
      else high = middle;
    }
    return [low, (time - t[low]) / (t[high] - t[low])];
  }

  /** Position of a drone, or of its load; false where it has none. */
  position(row, share, i, out, p = this.pos) {
    const a = 3 * (row * this.n + i), b = share ? a + 3 * this.n : a;
    out.set(p[a] + share * (p[b] - p[a]), p[a + 1] + share * (p[b + 1] - p[a + 1]), p[a + 2] + share * (p[b + 2] - p[a + 2]));
    return Math.abs(out.x) < HUGE && Math.abs(out.y) < HUGE && Math.abs(out.z) < HUGE;
  }

  /** Attitude of a drone, body to world, by normalised linear interpolation. */
  attitude(row, share, i, out) {
    const a = 4 * (row * this.n + i), b = share ? a + 4 * this.n : a, q = this.quat;
    const dot = q[a] * q[b] + q[a + 1] * q[b + 1] + q[a + 2] * q[b + 2] + q[a + 3] * q[b + 3];
    const v = dot < 0 ? -share : share, u = 1 - share;
    out.set(u * q[a] + v * q[b], u * q[a + 1] + v * q[b + 1], u * q[a + 2] + v * q[b + 2], u * q[a + 3] + v * q[b + 3]);
    return out.normalize();
  }

  /** Speed of a rotor, RPM. */
  speed(row, i, rotor) {
    return this.rpm[4 * (row * this.n + i) + rotor];
  }

  /** Target position of a drone; false where there is none. */
  target(row, i, out) {
    if (!this.targets) return false;
    const a = 3 * (row * this.n + i);
    out.set(this.targets[a], this.targets[a + 1], this.targets[a + 2]);
    return Number.isFinite(out.x + out.y + out.z);
  }

  /** Resultant force, m dv/dt, N, world: by differences of the logged velocity. */
  force(row, i, out) {
    return out.fromArray(this.rate(this.vel, row, i)).multiplyScalar(this.kinds[i].mass);
  }

  /** Resultant torque, J domega/dt + omega x J omega, N m, body: by differences of the logged angular velocity. */
  torque(row, i, out) {
    const rate = this.rate(this.omega, row, i), [jx, jy, jz] = this.kinds[i].inertia;
    const a = 3 * (row * this.n + i), [x, y, z] = this.omega.subarray(a, a + 3);
    return out.set(jx * rate[0] + (jz - jy) * y * z, jy * rate[1] + (jx - jz) * z * x, jz * rate[2] + (jy - jx) * x * y);
  }

  rate(array, row, i) {
    const before = Math.max(0, row - 1), after = Math.min(this.rows - 1, row + 1), dt = this.t[after] - this.t[before] || 1;
    const a = 3 * (before * this.n + i), b = 3 * (after * this.n + i);
    return [0, 1, 2].map((k) => (array[b + k] - array[a + k]) / dt);
  }

  /** Roll, pitch and yaw, rad. */
  angles(row, i) {
    const [x, y, z, w] = this.quat.subarray(4 * (row * this.n + i), 4 * (row * this.n + i) + 4);
    return [
      Math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
      Math.asin(Math.max(-1, Math.min(1, 2 * (w * y - z * x)))),
      Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    ];
  }
}

/**
 * Low and high corner of where drones are and are to be, and of obstacles no larger than that among them; and some
 * points, of which a camera that shows them shows all of it.
 */
export function bounds(worlds, scenes) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity], points = [];
  const include = (values, every) => {
    for (let i = 0; i < values.length; i += 3) {
      if (!(Math.hypot(values[i], values[i + 1], values[i + 2]) < HUGE)) continue;
      for (let k = 0; k < 3; k++) {
        low[k] = Math.min(low[k], values[i + k]);
        high[k] = Math.max(high[k], values[i + k]);
      }
      if ((i / 3) % every === 0) points.push(new Vector3(values[i], values[i + 1], values[i + 2]));
    }
  };
  for (const world of worlds)
    for (const array of [world.known("pos"), world.known("targets"), world.known("loads")]) include(array, Math.ceil((array.length * worlds.length) / 3 / SAMPLES));
  if (!(low[0] <= high[0])) include([-1, -1, 0, 1, 1, 1], 1);
  const [l, h] = [[...low], [...high]], reach = Math.max(0.5, Math.hypot(...h.map((x, k) => x - l[k])) / 2);
  const near = ({ half, low, high }) => half < reach && [0, 1, 2].every((k) => low[k] < h[k] + reach / 2 && high[k] > l[k] - reach / 2);
  for (const world of worlds)
    for (const box of scenes[world.scene].obstacles.map(extent).filter(near)) include([...box.low, ...box.high], 1);
  return { low: new Vector3(...low), high: new Vector3(...high), points };
}

export const scratch = { p: new Vector3(), v: new Vector3(), w: new Vector3(), q: new Quaternion(), r: new Quaternion() };
