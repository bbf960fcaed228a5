// Drones that are simulated in the page: their physics, controllers and policy are functions made from the JAX program
// (see export/simulation.py). The user pushes them, and changes wind, mass, a rotor and the delay.

import { Vector3 } from "three";

const RATE = 50; // rows per second
const MOST = 0.1; // s that is simulated at once, so that a slow computer slows the flight down and does not stop
const KEYS = { ArrowLeft: [0, 1], ArrowRight: [0, -1], ArrowUp: [1, 0], ArrowDown: [-1, 0] }; // directions, world
const PULL = 30; // N/kg of a distance of one metre between drone and pointer
const LARGEST = 12; // N/kg
const NEAR = 60; // pixels from the drone within which a pointer takes hold of it
const find = (id) => document.getElementById(id);

/** The functions that were made from the JAX program, by name. */
function compiled({ script, pilots }) {
  const names = ["physics", ...pilots.map(({ name }) => name)];
  return new Function(`${script}\nreturn { ${names} };`)();
}

/** Physics and pilots of one drone without a page: what is tested against JAX. */
export class Plant {
  constructor(simulation, goal = simulation.goals[0], functions = compiled(simulation)) {
    const { pilots, state, mass, dt } = simulation;
    Object.assign(this, { functions, pilots, goal: [...goal], dt, first: [...goal, ...state.slice(3)], nominal: mass });
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

/** Flies plants in real time, shows them, and lets the user disturb them. */
export class Simulation {
  constructor(player, header) {
    this.player = player;
    this.header = header;
    const functions = compiled(header.simulation);
    this.plants = header.simulation.goals.map((goal) => new Plant(header.simulation, goal, functions));
    this.held = new Set();
    this.pulled = null; // { plant, at }: by a pointer at these pixels
    this.last = performance.now();
    this.owed = 0;
    this.flown = 0; // rows since the start of the plants
    player.playing = true;
    player.panel.set("trail", "3");
    this.controls();
    player.changed();
    requestAnimationFrame((now) => this.frame(now));
  }

  controls() {
    const { plants } = this, [{ pilots, nominal }] = plants;
    find("simulation").hidden = false;
    for (const { name } of pilots) find("pilot").add(new Option(name, name));
    find("pilot").addEventListener("change", ({ target }) => {
      for (const plant of plants) plant.choose(target.value);
      find("gain").disabled = target.value === "policy";
    });
    find("gain").disabled = true;
    find("names").checked = plants.length === 1;
    const slider = (id, unit, condition) => {
      const input = find(id), output = input.nextElementSibling;
      const read = () => {
        for (const { conditions } of plants) conditions[id] = condition(Number(input.value));
        output.value = `${input.value} ${unit}`;
      };
      input.addEventListener("input", read);
      read();
    };
    slider("wind", "m/s", (x) => [0, x, 0]);
    slider("mass", "%", (x) => [(nominal * x) / 100]);
    slider("rotor", "%", (x) => x / 100);
    slider("delay", "ms", (x) => x / 1000);
    slider("gain", "%", (x) => x / 100);
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
      const plant = this.nearest(event.offsetX, event.offsetY);
      if (!plant) return;
      this.pulled = { plant, at: [event.offsetX, event.offsetY] };
      canvas.setPointerCapture(event.pointerId);
      event.stopImmediatePropagation(); // the camera stays
    }, true);
    canvas.addEventListener("pointermove", (event) => this.pulled && (this.pulled.at = [event.offsetX, event.offsetY]), true);
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => (this.pulled = null), true);
  }

  place(plant) { return new Vector3(...plant.state.slice(0, 3)); }

  /** The plant nearest to a pixel, if one is near. */
  nearest(x, y) {
    let found = null, least = NEAR;
    for (const plant of this.plants) {
      const at = this.player.stage.project(this.place(plant)), away = at ? Math.hypot(x - at[0], y - at[1]) : Infinity;
      if (away <= least) [found, least] = [plant, away];
    }
    return found;
  }

  /** A velocity of 3 m/s in a random horizontal direction. */
  kick() {
    for (const { state } of this.plants) {
      const angle = 2 * Math.PI * Math.random();
      state[7] += 3 * Math.cos(angle);
      state[8] += 3 * Math.sin(angle);
    }
  }

  again() {
    for (const plant of this.plants) plant.reset();
    this.flown = 0;
    this.restart();
  }

  /** External force on a plant, N, world: of the keys and of the pointer. */
  push(plant) {
    const { player, pulled } = this, [mass] = plant.conditions.mass, force = new Vector3();
    for (const key of this.held) force.add(new Vector3(...KEYS[key], 0).multiplyScalar(LARGEST / 2));
    const at = pulled?.plant === plant && player.stage.project(this.place(plant));
    if (at) {
      const { camera, canvas } = player.stage, away = camera.position.distanceTo(this.place(plant));
      const metres = (2 * away * Math.tan((camera.fov * Math.PI) / 360)) / canvas.clientHeight; // of a pixel
      const across = new Vector3().setFromMatrixColumn(camera.matrixWorld, 0), up = new Vector3().setFromMatrixColumn(camera.matrixWorld, 1);
      force.addScaledVector(across, PULL * metres * (pulled.at[0] - at[0])).addScaledVector(up, -PULL * metres * (pulled.at[1] - at[1]));
    }
    return force.clampLength(0, LARGEST).multiplyScalar(mass).toArray();
  }

  frame(now) {
    requestAnimationFrame((now) => this.frame(now));
    const passed = Math.min(MOST, (now - this.last) / 1000);
    this.last = now;
    if (!this.player.playing) return;
    this.owed += passed * this.player.panel.speed;
    for (const plant of this.plants) plant.conditions.push = this.push(plant);
    this.fly(Math.floor(this.owed * RATE));
    if (this.player.end > this.header.simulation.span) this.restart();
  }

  /** Fly some rows further, and show them. */
  fly(count) {
    const { plants, player } = this, rows = this.rows([]);
    for (let k = 1; k <= count; k++) {
      const due = Math.round(++this.flown / RATE / plants[0].dt); // in all, as a row need not be a whole number of steps
      for (const plant of plants) while (plant.steps < due) plant.step();
      rows.t.push(player.end + k / RATE);
      for (const [name, numbers] of Object.entries(this.rows(plants))) rows[name].push(...numbers);
    }
    this.owed -= count / RATE;
    if (count) player.append(rows);
  }

  /** What the viewer shows of some plants, in one row. */
  rows(plants) {
    const of = (from, to) => plants.flatMap(({ state }) => state.slice(from, to));
    return { t: [], pos: of(0, 3), quat: of(3, 7), vel: of(7, 10), omega: of(10, 13), rpm: of(13, 17), targets: plants.flatMap(({ goal }) => goal) };
  }

  /** Begin the plots and the trail anew. */
  restart() {
    const [world] = this.header.worlds;
    for (const [name, numbers] of Object.entries({ ...this.rows(this.plants), t: [0] })) world[name] = Float32Array.from(numbers);
    this.player.restart(this.header);
    this.player.playing = true;
  }
}
