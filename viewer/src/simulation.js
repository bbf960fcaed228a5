// A drone that is simulated in the page: its physics, controllers and policy are functions made from the JAX program
// (see export/simulation.py). The user pushes it, and changes wind, mass, a rotor and the delay.

import { Vector3 } from "three";

const RATE = 50; // rows per second
const MOST = 0.1; // s that is simulated at once, so that a slow computer slows the flight down and does not stop
const KEYS = { ArrowLeft: [0, 1], ArrowRight: [0, -1], ArrowUp: [1, 0], ArrowDown: [-1, 0] }; // directions, world
const PULL = 30; // N/kg of a distance of one metre between drone and pointer
const LARGEST = 12; // N/kg
const NEAR = 60; // pixels from the drone within which a pointer takes hold of it
const find = (id) => document.getElementById(id);

/** Physics and pilots without a page: what is tested against JAX. */
export class Plant {
  constructor({ script, pilots, state, goal, mass, dt }) {
    const names = ["physics", ...pilots.map(({ name }) => name)];
    this.functions = new Function(`${script}\nreturn { ${names} };`)();
    Object.assign(this, { pilots, goal: [...goal], dt, first: state, nominal: mass });
    this.conditions = { wind: [0, 0, 0], mass: [mass], push: [0, 0, 0], rotor: 1, delay: 0, gain: 1 };
    this.reset();
    this.choose(pilots[0].name);
  }

  reset() {
    this.state = [...this.first];
    this.rpm = this.first.slice(13);
    this.sent = []; // commands that wait for their delay
    this.steps = 0;
    if (this.pilot) this.choose(this.pilot.name);
  }

  choose(name) {
    this.pilot = this.pilots.find((pilot) => pilot.name === name);
    this.memory = [...this.pilot.memory];
  }

  step() {
    const { pilot, conditions, functions } = this;
    if (this.steps % pilot.period === 0) this.sent.push([this.steps + Math.round(conditions.delay / this.dt), this.command()]);
    while (this.sent.length && this.sent[0][0] <= this.steps) this.rpm = this.sent.shift()[1];
    const [weak, ...others] = this.rpm, out = [];
    functions.physics(out, this.state, [weak * Math.sqrt(conditions.rotor), ...others], conditions.wind, conditions.mass, conditions.push);
    this.state = out;
    this.steps++;
  }

  command() {
    const { pilot, functions } = this, out = [];
    functions[pilot.name](out, pilot.gains.map((x) => x * this.conditions.gain), this.memory, this.state, this.goal);
    this.memory = out.slice(0, -4);
    return out.slice(-4);
  }
}

/** Flies a plant in real time, shows it, and lets the user disturb it. */
export class Simulation {
  constructor(player, header) {
    this.player = player;
    this.header = header;
    this.plant = new Plant(header.simulation);
    this.held = new Set();
    this.pulled = null;
    this.last = performance.now();
    this.owed = 0;
    player.playing = true;
    player.panel.set("trail", "3");
    this.controls();
    requestAnimationFrame((now) => this.frame(now));
  }

  controls() {
    const { plant } = this, { conditions } = plant;
    find("simulation").hidden = false;
    for (const { name } of plant.pilots) find("pilot").add(new Option(name, name));
    find("pilot").addEventListener("change", ({ target }) => {
      plant.choose(target.value);
      find("gain").disabled = target.value === "policy";
    });
    find("gain").disabled = true;
    const slider = (id, unit, apply) => {
      const input = find(id), output = input.nextElementSibling;
      const read = () => (apply(Number(input.value)), (output.value = `${input.value} ${unit}`));
      input.addEventListener("input", read);
      read();
    };
    slider("wind", "m/s", (x) => (conditions.wind = [0, x, 0]));
    slider("mass", "%", (x) => (conditions.mass = [(plant.nominal * x) / 100]));
    slider("rotor", "%", (x) => (conditions.rotor = x / 100));
    slider("delay", "ms", (x) => (conditions.delay = x / 1000));
    slider("gain", "%", (x) => (conditions.gain = x / 100));
    find("again").addEventListener("click", () => this.again());
    find("kick").addEventListener("click", () => this.kick());
    addEventListener("keydown", (event) => {
      if (!KEYS[event.key] || event.target.tagName === "SELECT" || event.target.type === "range") return;
      this.held.add(event.key);
      event.preventDefault();
      event.stopImmediatePropagation(); // these keys move the time of a recorded flight
    }, true);
    addEventListener("keyup", (event) => this.held.delete(event.key));
    addEventListener("blur", () => this.held.clear());
    const canvas = find("view");
    canvas.addEventListener("pointerdown", (event) => {
      const at = this.player.stage.project(this.place());
      if (!at || Math.hypot(event.offsetX - at[0], event.offsetY - at[1]) > NEAR) return;
      this.pulled = [event.offsetX, event.offsetY];
      canvas.setPointerCapture(event.pointerId);
      event.stopImmediatePropagation(); // the camera stays
    }, true);
    canvas.addEventListener("pointermove", (event) => this.pulled && (this.pulled = [event.offsetX, event.offsetY]), true);
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => (this.pulled = null), true);
  }

  place() { return new Vector3(...this.plant.state.slice(0, 3)); }

  /** A velocity of 3 m/s in a random horizontal direction. */
  kick() {
    const angle = 2 * Math.PI * Math.random();
    this.plant.state[7] += 3 * Math.cos(angle);
    this.plant.state[8] += 3 * Math.sin(angle);
  }

  again() {
    this.plant.reset();
    this.restart();
  }

  /** External force, N, world: of the keys and of the pointer. */
  push() {
    const { plant, player } = this, [mass] = plant.conditions.mass, force = new Vector3();
    for (const key of this.held) force.add(new Vector3(...KEYS[key], 0).multiplyScalar(LARGEST / 2));
    const at = this.pulled && player.stage.project(this.place());
    if (at) {
      const { camera, canvas } = player.stage, away = camera.position.distanceTo(this.place());
      const metres = (2 * away * Math.tan((camera.fov * Math.PI) / 360)) / canvas.clientHeight; // of a pixel
      const across = new Vector3().setFromMatrixColumn(camera.matrixWorld, 0), up = new Vector3().setFromMatrixColumn(camera.matrixWorld, 1);
      force.addScaledVector(across, PULL * metres * (this.pulled[0] - at[0])).addScaledVector(up, -PULL * metres * (this.pulled[1] - at[1]));
    }
    return force.clampLength(0, LARGEST).multiplyScalar(mass).toArray();
  }

  frame(now) {
    requestAnimationFrame((now) => this.frame(now));
    const passed = Math.min(MOST, (now - this.last) / 1000);
    this.last = now;
    if (!this.player.playing) return;
    this.owed += passed * this.player.panel.speed;
    this.plant.conditions.push = this.push();
    this.fly(Math.floor(this.owed * RATE));
    if (this.player.end > this.header.simulation.span) this.restart();
  }

  /** Fly some rows further, and show them. */
  fly(count) {
    const { plant, player } = this, rows = { t: [], pos: [], quat: [], vel: [], omega: [], rpm: [], targets: [] };
    for (let k = 1; k <= count; k++) {
      for (let i = 0; i < Math.round(1 / RATE / plant.dt); i++) plant.step();
      const { state } = plant;
      rows.t.push(player.end + k / RATE);
      rows.pos.push(...state.slice(0, 3));
      rows.quat.push(...state.slice(3, 7));
      rows.vel.push(...state.slice(7, 10));
      rows.omega.push(...state.slice(10, 13));
      rows.rpm.push(...state.slice(13));
      rows.targets.push(...plant.goal);
    }
    this.owed -= count / RATE;
    if (count) player.append(rows);
  }

  /** Begin the plots and the trail anew. */
  restart() {
    const { state, goal } = this.plant, [world] = this.header.worlds;
    const now = { t: [0], pos: state.slice(0, 3), quat: state.slice(3, 7), vel: state.slice(7, 10), omega: state.slice(10, 13), rpm: state.slice(13), targets: goal };
    for (const [name, numbers] of Object.entries(now)) world[name] = Float32Array.from(numbers);
    this.player.restart(this.header);
    this.player.playing = true;
  }
}
