// Plots of chosen signals, linked to the time line.

import { extremes } from "./extremes.js";
import { legible, theme } from "./theme.js";

const LINES = ["#0072b2", "#d55e00", "#009e73", "#cc79a7"].map(legible);
const MOST = 24; // drones with a line of their own
const MARGIN = { left: 52, right: 16, top: 20, bottom: 18 };

const component = (array, size, k) => (world, row, i) => world[array][size * (row * world.n + i) + k];
const vector = (name, symbol, unit, array, target) =>
  ["x", "y", "z"].map((axis, k) => ({
    name: `${name} ${axis}`, unit, value: component(array, 3, k),
    target: target && ((world, row, i) => (world[target] ? world[target][3 * (row * world.n + i) + k] : NaN)),
  }));

export const SIGNALS = [
  {
    name: "distance from target", unit: "m", // of the load of a drone that carries one
    value: (world, row, i) => {
      if (!world.targets) return NaN;
      const a = 3 * (row * world.n + i), p = world.loads ?? world.pos, q = world.targets;
      return Math.hypot(p[a] - q[a], p[a + 1] - q[a + 1], p[a + 2] - q[a + 2]);
    },
  },
  ...vector("position", "p", "m", "pos", "targets"),
  ...vector("velocity", "v", "m/s", "vel", "target_vel"),
  { name: "speed", unit: "m/s", value: (world, row, i) => { const a = 3 * (row * world.n + i); return Math.hypot(world.vel[a], world.vel[a + 1], world.vel[a + 2]); } },
  ...["roll", "pitch", "yaw"].map((name, k) => ({ name, unit: "rad", value: (world, row, i) => world.angles(row, i)[k] })),
  ...vector("body rate", "ω", "rad/s", "omega"),
  { name: "rotor speeds", unit: "RPM", parts: ["rotor 0", "rotor 1", "rotor 2", "rotor 3"], value: (world, row, i, k) => world.speed(row, i, k) },
  {
    name: "thrust over weight", unit: "",
    value: (world, row, i) => {
      const kind = world.kinds[i];
      return [0, 1, 2, 3].reduce((sum, k) => sum + kind.kf * world.speed(row, i, k) ** 2, 0) / (kind.mass * kind.gravity);
    },
  },
];

/** One plot: a signal of the drones of the world that is looked at. */
export class Plot {
  constructor(box, signal, onSeek) {
    this.canvas = box.querySelector("canvas");
    this.context = this.canvas.getContext("2d", { willReadFrequently: true }); // drawn by the processor, which is faster without a graphics processor
    this.cursor = box.querySelector("i");
    this.select = box.querySelector("select");
    this.readout = box.querySelector("output");
    SIGNALS.forEach(({ name, unit }, k) => this.select.add(new Option(unit ? `${name} (${unit})` : name, k)));
    this.select.value = SIGNALS.findIndex(({ name }) => name === signal);
    this.select.addEventListener("change", () => (this.stale = true));
    const seek = (event) => event.buttons & 1 && onSeek(this.timeAt(event.offsetX));
    this.canvas.addEventListener("pointerdown", (event) => { this.canvas.setPointerCapture(event.pointerId); seek(event); });
    this.canvas.addEventListener("pointermove", seek);
    this.stale = true;
  }

  /** Look at another world or drone. */
  look(world, drone, colors, end) {
    Object.assign(this, { world, drone, colors, end, stale: true });
  }

  timeAt(x) {
    const width = this.canvas.clientWidth - MARGIN.left - MARGIN.right;
    return Math.max(0, Math.min(1, (x - MARGIN.left) / width)) * this.end;
  }

  draw(time) {
    const { clientWidth: width, clientHeight: height } = this.canvas, ratio = window.devicePixelRatio;
    if (!width || !height) return;
    const pixels = [Math.round(width * ratio), Math.round(height * ratio)];
    if (this.stale || this.canvas.width !== pixels[0] || this.canvas.height !== pixels[1]) {
      [this.canvas.width, this.canvas.height] = pixels;
      this.paint(width, height, ratio);
      this.stale = false;
    }
    const x = MARGIN.left + ((width - MARGIN.left - MARGIN.right) * Math.min(time, this.end)) / this.end;
    this.cursor.style.transform = `translateX(${x - 0.75}px)`;
    this.read(time);
  }

  read(time) {
    const signal = SIGNALS[this.select.value], row = this.world.at(time)[0];
    const parts = signal.parts ?? [""];
    const text = parts.map((_, k) => short(signal.value(this.world, row, this.drone, k))).join("  ");
    const of = this.world.n > 1 ? `${this.world.labels[this.drone]}: ` : "", full = `${of}${text} ${signal.unit}`;
    if (this.readout.value !== full) this.readout.value = full;
  }

  paint(width, height, ratio) {
    const { context } = this;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const curves = this.curves(width);
    let low = Infinity, high = -Infinity;
    for (const { y } of curves) for (const x of y) if (Number.isFinite(x)) { low = Math.min(low, x); high = Math.max(high, x); }
    if (!(low <= high)) return this.note(context, width, height);
    const room = Math.max(0.06 * (high - low), 1e-3 * Math.abs(high), 1e-6);
    [low, high] = [low - room, high + room];
    const left = MARGIN.left, right = width - MARGIN.right, top = MARGIN.top, bottom = height - MARGIN.bottom;
    const X = (t) => left + ((right - left) * t) / this.end, Y = (y) => bottom - ((bottom - top) * (y - low)) / (high - low);
    context.font = "11px system-ui, sans-serif";
    context.lineWidth = 1;
    context.strokeStyle = theme.grid;
    context.fillStyle = theme.note;
    context.textAlign = "right";
    context.textBaseline = "middle";
    const levels = ticks(low, high, 4);
    for (const y of levels) {
      line(context, left, Y(y), right, Y(y));
      context.fillText(labelled(y, levels[1] - levels[0]), left - 5, Y(y));
    }
    context.textAlign = "center";
    context.textBaseline = "top";
    for (const t of ticks(0, this.end, Math.max(2, (right - left) / 90))) {
      line(context, X(t), top, X(t), bottom);
      context.fillText(`${short(t)} s`, X(t), bottom + 4);
    }
    context.save();
    context.beginPath();
    context.rect(left, top, right - left, bottom - top);
    context.clip();
    for (const { t, y, color, wide, dashed } of curves) {
      context.strokeStyle = color;
      context.lineWidth = wide ? 2 : 1;
      context.globalAlpha = wide || dashed ? 1 : 0.45;
      context.setLineDash(dashed ? [5, 4] : []);
      context.beginPath();
      let pen = false;
      for (let k = 0; k < t.length; k++) {
        if (!Number.isFinite(y[k])) { pen = false; continue; }
        if (pen) context.lineTo(X(t[k]), Y(y[k]));
        else context.moveTo(X(t[k]), Y(y[k]));
        pen = true;
      }
      context.stroke();
    }
    context.restore();
  }

  note(context, width, height) {
    context.font = "12px system-ui, sans-serif";
    context.fillStyle = theme.note;
    context.textAlign = "center";
    context.fillText("no values", width / 2, height / 2);
  }

  /** The drone that is looked at with its target or parts, above thin lines of the others. */
  curves(width) {
    const { world, drone } = this, signal = SIGNALS[this.select.value];
    const curve = (value, look) => {
      const rows = extremes(world.rows, width, value);
      return { t: rows.map((row) => world.t[row]), y: rows.map(value), ...look };
    };
    if (signal.parts) return signal.parts.map((_, k) => curve((row) => signal.value(world, row, drone, k), { color: LINES[k], wide: true }));
    const others = world.labels.map((_, i) => i).filter((i) => i !== drone).slice(0, MOST);
    const found = others.map((i) => curve((row) => signal.value(world, row, i), { color: this.colors(i) }));
    if (signal.target) found.push(curve((row) => signal.target(world, row, drone), { color: theme.target, dashed: true }));
    found.push(curve((row) => signal.value(world, row, drone), { color: this.colors(drone), wide: true }));
    return found;
  }
}

function line(context, x0, y0, x1, y1) {
  context.beginPath();
  context.moveTo(x0, y0);
  context.lineTo(x1, y1);
  context.stroke();
}

function ticks(low, high, count) {
  const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((x) => x * power >= 0.8 * rough);
  const found = [];
  for (let k = Math.ceil(low / step); k * step <= high; k++) found.push(k * step);
  return found;
}

/** A tick's number with the digits that tell it from the next one, `step` away. */
function labelled(y, step) {
  if (!(step > 1e-6) || Math.abs(y) >= 1e5) return short(y);
  return y.toFixed(Math.max(0, Math.ceil(-Math.log10(step) - 1e-9)));
}

/** A number in few characters. */
export function short(x) {
  if (!Number.isFinite(x)) return "–";
  const size = Math.abs(x);
  if (size && (size < 1e-3 || size >= 1e5)) return x.toExponential(1);
  return String(Number(x.toPrecision(size >= 1000 ? 5 : 3)));
}
