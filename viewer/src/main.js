// The page: decodes the flight, builds the scene, and plays it.

import { Vector3 } from "three";
import { Arrows, CONTACT, FORCE, THRUST, TORQUE } from "./arrows.js";
import { Fleet } from "./fleet.js";
import { armOf, bounds, scratch, World } from "./flight.js";
import { CameraImages } from "./camera.js";
import { drawCurve } from "./curve.js";
import { handles } from "./handles.js";
import { History } from "./history.js";
import { JET, Jets } from "./jets.js";
import { Loads } from "./loads.js";
import { Names, named } from "./names.js";
import { Panel } from "./panel.js";
import { decode } from "./payload.js";
import { Plot, short } from "./plots.js";
import { comparable, ERROR, Ribbon } from "./ribbon.js";
import { Plant, Simulation } from "./simulation.js";
import { solids } from "./solids.js";
import { Stage } from "./stage.js";
import { legible, theme } from "./theme.js";
import { Trail } from "./trails.js";
import { PathVectors, VECTOR } from "./vectors.js";

const MARGIN = 2; // arms of the largest drone, which the camera shows around the flight
const STILL = 200; // ms without a change after which the picture is drawn in full resolution
const BEHIND = 0.4; // s, how far a flight that is running may be ahead of what is shown
const ROOM = 0.2; // share of its extent that a flight that is running may grow to every side before the camera moves
const REPAINT = 200, SELDOM = 600; // ms between two paintings of the plots of a flight that is running, the latter without a graphics processor
const find = (id) => document.getElementById(id);

class Player {
  constructor(header) {
    this.worlds = header.worlds.map((entries, w) => new World(entries, header.vehicles, w));
    this.title = header.title;
    this.time = 0;
    this.playing = false;
    this.begin(header);
    this.last = null;
    const palette = header.palette.map(legible);
    this.colors = (w, i) => palette[(this.worlds[w].n > 1 || this.worlds.length === 1 ? i : w) % palette.length];
    this.stage = new Stage(find("view"));
    this.fleet = new Fleet(this.stage, this.worlds, header.vehicles, this.colors);
    this.surroundings = header.scenes.map((scene) => ({ ...scene, groups: [] }));
    this.trails = this.worlds.map((world, w) => new Trail(this.stage, world, (i) => this.colors(w, i)));
    this.arrows = this.worlds.map((world, w) => new Arrows(this.stage, world, (i) => this.colors(w, i)));
    this.loads = this.worlds.map((world) => new Loads(this.stage, world));
    this.jets = new Jets(this.stage, this.worlds);
    this.vectors = this.worlds.filter(({ arrows }) => arrows).map((world) => new PathVectors(this.stage, world));
    this.ribbon = comparable(this.worlds) ? new Ribbon(this.stage, this.worlds) : null;
    this.panel = new Panel(this, this);
    find("error").checked = Boolean(header.error);
    this.history = header.history && new History(header.history, (w) => this.chooseWorld(w));
    const first = this.worlds[0];
    this.panel.set("trail", first.n > 60 ? "1" : "Infinity");
    this.panel.set("layout", header.layout);
    this.plots = [...document.querySelectorAll(".plot")].map((box, k) => new Plot(box, header.signals[k], (time) => this.seek(time)));
    this.names = new Names();
    this.images = new CameraImages(find("cameras"));
    this.frames = 0;
    this.moved = 0;
    if (location.hash === "#view") this.embed();
    new ResizeObserver(() => this.resize()).observe(find("stage"));
    this.resize();
    this.changed();
    this.stage.home();
    requestAnimationFrame((now) => this.frame(now));
  }

  /** Show the view and the time line alone, in a page that scrolls. */
  embed() {
    document.body.classList.add("embedded");
    this.stage.orbit.enableZoom = false;
    this.stage.canvas.style.touchAction = "pan-y";
  }

  /** Learn whether the flight is still running, or is to be shown again and again. */
  begin({ live, play }) {
    this.end = Math.max(...this.worlds.map((world) => world.end));
    this.running = Boolean(live?.running);
    this.again = Boolean(play || live) && !this.running; // and again
    if (play) this.playing = true;
    this.live = Boolean(live);
    this.span = Math.max(this.end, live?.end ?? 0); // s, length of the time line
    this.following = this.running;
    drawCurve(find("curve"), live?.curve);
    if (live) {
      this.worlds[0].reserve(live.rows);
      this.playing = true;
    }
  }

  /** Show another flight of the same team. */
  restart(header) {
    const [world] = this.worlds;
    Object.assign(world, new World(header.worlds[0], header.vehicles, 0));
    for (const scene of this.surroundings) for (const group of scene.groups) this.stage.scene.remove(group);
    this.surroundings = header.scenes.map((scene) => ({ ...scene, groups: [] }));
    this.begin(header);
    this.time = 0;
    for (const trail of this.trails) trail.restart();
    this.panel.describe(header.title, this);
    this.arranged = null;
    this.changed();
  }

  /** More of a flight that is running. */
  append(rows) {
    const [world] = this.worlds;
    world.append(rows);
    this.end = world.end;
    this.span = Math.max(this.span, this.end);
    for (const trail of this.trails) trail.extend();
    if (!this.within(rows.pos)) this.arranged = null; // the camera has to see more
    if (this.arranged === null || performance.now() > (this.painted ?? 0) + (this.stage.hurried ? SELDOM : REPAINT)) {
      this.painted = performance.now();
      this.changed();
    }
    this.stage.dirty = true;
  }

  /** Whether positions are in the box that the camera was fitted to. */
  within(pos) {
    const { low, high } = this.fitted, inside = (x, k) => !(x < low[k] - 1e-3 || x > high[k] + 1e-3);
    return pos.every((x, k) => inside(x, k % 3));
  }

  /** The flight is over, or it cannot be heard of any more. */
  finish() {
    if (!this.running) return;
    this.running = this.following = false;
    this.span = this.end;
    this.arranged = null;
    this.panel.describe(this.title, this);
    this.changed();
  }

  resize() {
    this.stage.resize();
    for (const plot of this.plots ?? []) plot.stale = true;
  }

  /** Something was chosen: arrange everything anew. */
  changed() {
    const { panel, stage } = this, world = this.worlds[panel.world];
    const key = `${panel.layout} ${panel.layout === "grid" ? "" : panel.world}`;
    if (this.arranged !== key) {
      this.arrange();
      this.arranged = key;
    }
    this.fleet.size = panel.size;
    for (const plot of this.plots) plot.look(world, panel.drone, (i) => this.colors(panel.world, i), this.span);
    this.pose(scratch.p, scratch.q);
    if (this.history) this.showPolicy(world);
    if (stage.mode !== panel.mode) stage.setMode(panel.mode, scratch.p, (panel.size || 1) * this.arm);
    this.labelNames();
    stage.dirty = true;
  }

  /** Show the policy of a world of the film of a training. */
  showPolicy(world) {
    this.end = this.span = world.end;
    this.time = Math.min(this.time, this.end);
    this.history.mark(world.index, world.name);
    this.panel.describe(`${this.title}, ${world.name}`, this);
  }

  chooseWorld(w) {
    this.panel.setWorld(w, this.worlds[w]);
    this.time = 0;
    this.changed();
  }

  /** Where each world is drawn, and the obstacles around it. */
  arrange() {
    const { panel, worlds, stage } = this, mode = worlds.length > 1 ? panel.layout : "ghosts";
    const seen = this.history ? [worlds[this.history.kept]] : worlds;
    const { low, high, points: corners } = bounds(seen, this.surroundings), span = high.clone().sub(low), columns = Math.ceil(Math.sqrt(worlds.length));
    const [dx, dy] = [1.25 * Math.max(span.x, 0.5), 1.25 * Math.max(span.y, 0.5)];
    stage.margin = MARGIN * Math.max(...seen.flatMap(({ kinds }) => kinds.map(armOf)));
    this.sideBySide = mode === "grid";
    this.top = low.clone().add(high).multiplyScalar(0.5).setZ(high.z);
    this.layout = worlds.map((_, w) => ({
      offset: mode === "grid" ? new Vector3((w % columns) * dx, -Math.floor(w / columns) * dy, 0) : new Vector3(),
      ghost: mode === "ghosts" && w !== panel.world,
      hidden: mode === "alone" && w !== panel.world,
    }));
    for (const scene of this.surroundings) for (const group of scene.groups.splice(0)) stage.scene.remove(group);
    const obstacles = [];
    worlds.forEach((world, w) => {
      if (mode !== "grid" && w !== panel.world) return;
      const scene = this.surroundings[world.scene], group = solids(scene);
      obstacles.push(...group.children.filter((mesh) => !mesh.material.transparent));
      group.position.copy(this.layout[w].offset);
      scene.groups.push(group);
      stage.scene.add(group);
    });
    const last = this.layout[worlds.length - 1].offset, wide = this.layout[Math.min(columns, worlds.length) - 1].offset;
    const ground = this.surroundings.some((scene) => scene.ground);
    if (this.running) {
      const room = span.clone().multiplyScalar(ROOM);
      corners.push(low.sub(room).clone(), high.add(room).clone());
    }
    this.fitted = { low: low.toArray(), high: high.toArray() };
    low.z = ground ? Math.min(low.z, 0) : low.z;
    const points = this.layout.flatMap(({ offset }) => corners.map((point) => point.clone().add(offset)));
    if (mode === "grid") stage.fit(low.clone().setY(low.y + last.y), high.clone().setX(high.x + wide.x), ground, obstacles, points);
    else stage.fit(low, high, ground, obstacles, points, this.live || this.history);
  }

  /** Pose of the drone that is looked at. */
  pose(pos, quat) {
    const { panel } = this, world = this.worlds[panel.world], [row, share] = world.at(this.time);
    const there = world.position(row, share, panel.drone, pos);
    pos.add(this.layout[panel.world].offset);
    world.attitude(row, share, panel.drone, quat);
    this.arm = armOf(world.kinds[panel.drone]);
    return there;
  }

  seek(time) {
    this.time = Math.max(0, Math.min(this.end, time));
    this.following = this.running && time >= this.end;
    this.stage.dirty = true;
  }

  step(rows) {
    const world = this.worlds[this.panel.world], [row, share] = world.at(this.time);
    this.playing = false;
    this.seek(world.t[Math.max(0, Math.min(world.rows - 1, row + rows + (rows < 0 && share > 1e-6 ? 1 : 0)))]);
  }

  /** Keep up with a flight that is running. */
  follow() {
    this.seek(Infinity);
    this.playing = true;
  }

  toggle() {
    if (this.running && this.playing) this.following = false;
    if (!this.playing && !this.running && this.time >= this.end) this.time = 0;
    this.playing = !this.playing;
    this.stage.dirty = true;
  }

  home() {
    this.panel.setMode("orbit");
    this.stage.home();
  }

  frame(now) {
    requestAnimationFrame((now) => this.frame(now));
    const passed = this.last === null ? 0 : Math.min(0.25, (now - this.last) / 1000);
    this.last = now;
    if (this.playing) {
      this.stage.adapt(passed);
      this.time += passed * (this.following ? 1 : this.panel.speed);
      if (this.following && this.end - this.time > BEHIND) this.time = this.end - BEHIND / 2;
      if (this.time >= this.end) {
        this.time = this.again ? 0 : this.end;
        this.playing = this.running || this.again;
        if (this.history) this.chooseWorld((this.panel.world + 1) % this.worlds.length);
      }
    }
    if (this.playing || this.stage.dirty) {
      if (!this.playing && !this.stage.sharp) this.moved = now;
      this.draw(this.playing ? passed * this.panel.speed : 0);
    } else if (now > this.moved + STILL) this.stage.setSharp(true);
  }

  draw(passed) {
    const { panel, stage, time } = this, shown = panel.shown;
    if (this.pose(scratch.p, scratch.q)) stage.track(scratch.p, scratch.q, (panel.size || 1) * this.arm);
    if (panel.mode !== "board") stage.orbit.update(); // which turns the camera to its own target
    this.fleet.place(time, passed, this.layout, panel.mode === "board" ? panel : null);
    this.trails.forEach((trail, w) => trail.show(time, panel.trail, this.layout[w], stage));
    this.arrows.forEach((arrows, w) => arrows.show(time, shown, this.layout[w], this.fleet));
    this.loads.forEach((loads, w) => loads.show(time, this.layout[w], this.fleet));
    this.jets.show(time, shown.jets, this.layout);
    for (const vectors of this.vectors) vectors.show(this.layout[vectors.world.index]);
    this.ribbon?.show(time, panel.trail, this.compared);
    stage.render();
    this.explain();
    if (!stage.hurried || this.frames % 2 === 0) this.placeNames();
    if (!stage.hurried || this.frames % 4 === 0) {
      for (const plot of this.plots) plot.draw(time);
      this.images.show(this.worlds[panel.world], panel.drone, time);
      panel.showTime(time, this.span, this.playing, this.following);
    }
    this.frames++;
  }

  /** Whether the error between two flights is shown: they are in the same place. */
  get compared() {
    return Boolean(this.ribbon) && this.panel.shown.error && this.panel.layout === "ghosts";
  }

  /** Colors, the grid, and how much larger than they are drones are drawn. */
  explain() {
    const { panel } = this, rows = [];
    const row = (color, text) => rows.push(`<i style="background:${color}"></i>${text}`);
    if (panel.shown.thrust) row(THRUST, "thrust of a rotor");
    if (panel.shown.wrench) row(FORCE, "resultant force") && row(TORQUE, "resultant torque");
    if (panel.shown.wrench && this.worlds.some(({ contacts }) => contacts)) row(CONTACT, "contact force");
    if (this.vectors.length) row(VECTOR, "vectors along the path");
    if (this.compared) row(ERROR, `${short(100 * this.ribbon.distance(this.time, panel.drone))} cm between the two flights`);
    if (panel.shown.jets) row(JET, "downwash, as wide as it has half the speed of its axis");
    if (this.stage.cell && this.surroundings.some((scene) => scene.ground)) rows.push(`squares of ${short(this.stage.cell)} m`);
    const times = Number(this.fleet.largest.toPrecision(2));
    if (panel.size > 1) rows.push(`drones are drawn ${times} times as large as they are`);
    else if (times > 1) rows.push(`drones are drawn up to ${times} times as large as they are`);
    const text = rows.join("\n");
    if (text !== this.explained) find("legend").innerHTML = this.explained = text;
  }

  labelNames() {
    const { panel } = this, world = this.worlds[panel.world], color = (drone) => this.colors(world.index, drone);
    const drones = panel.shown.names ? named(world, panel.drone) : [];
    const labels = drones.map((drone) => ({ drone, text: world.labels[drone], color: color(drone) }));
    if (this.sideBySide && panel.shown.names)
      this.worlds.forEach(({ name }, w) => labels.push({ point: this.top.clone().add(this.layout[w].offset), text: name, color: theme.note }));
    this.names.list(labels);
  }

  placeNames() {
    const { panel } = this, world = this.worlds[panel.world], [row, share] = world.at(this.time), { p } = scratch;
    const { offset } = this.layout[panel.world];
    this.names.place(({ drone, point }) => {
      if (point) return this.stage.project(point);
      if (!world.position(row, share, drone, p) || (panel.mode === "board" && drone === panel.drone)) return null;
      p.add(offset).setZ(p.z + 1.1 * this.arm * this.fleet.scale(world.vehicle[drone], p));
      return this.stage.project(p);
    });
  }
}

function begin(header) {
  const player = new Player(header);
  find("status").textContent = "";
  window.jaxdrones = handles(player);
  if (header.simulation) {
    window.jaxdrones.simulation = new Simulation(player, header);
    window.jaxdrones.plant = () => new Plant(header.simulation);
  }
  document.documentElement.dataset.ready = "true";
  return player;
}

/** Show what a program on this machine flies, as it tells it. */
function listen(address) {
  find("status").textContent = "waiting for the flight …";
  let player = null, told = Promise.resolve();
  const source = new EventSource(address);
  const on = (event, act) => source.addEventListener(event, ({ data }) => (told = told.then(() => act(data)).catch(failed)));
  on("begin", async (data) => {
    const header = await decode(data);
    if (player) player.restart(header);
    else player = begin(header);
    document.title = header.title;
  });
  on("rows", async (data) => player.append((await decode(data)).rows));
  const finish = () => {
    source.close();
    told = told.then(() => (player ? player.finish() : (find("status").textContent = "There is no flight any more."))).catch(failed);
  };
  on("end", finish);
  source.addEventListener("error", finish); // the program has ended; the page stays
}

function failed(error) {
  find("status").textContent = `The flight cannot be shown: ${error.message}`;
  throw error;
}

async function start() {
  const payload = find("payload").textContent;
  if (payload.startsWith("live:")) return listen(payload.slice(5));
  find("status").textContent = "loading the flight …";
  try {
    begin(await decode(payload));
  } catch (error) {
    failed(error);
  }
}

start();
