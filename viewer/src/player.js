// Plays flights: time, the choices of the user, and what is drawn in a frame.

import { Actors } from "./actors.js";
import { Arrangement } from "./arrangement.js";
import { CameraImages } from "./camera.js";
import { drawCurve } from "./curve.js";
import { armOf, scratch, World } from "./flight.js";
import { History } from "./history.js";
import { Legend } from "./legend.js";
import { Names } from "./names.js";
import { Panel } from "./panel.js";
import { Plot } from "./plots.js";
import { Stage } from "./stage.js";
import { legible } from "./theme.js";

const STILL = 200; // ms without a change after which the picture is drawn in full resolution
const BEHIND = 0.4; // s, how far a flight that is running may be ahead of what is shown
const REPAINT = 200, SELDOM = 600; // ms between two paintings of the plots of a flight that is running, the latter without a graphics processor
const find = (id) => document.getElementById(id);

export class Player {
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
    this.actors = new Actors(this.stage, this.worlds, header.vehicles, this.colors);
    this.arrangement = new Arrangement(this.stage, this.worlds, header.scenes);
    this.panel = new Panel(this, this);
    for (const id of ["error", "jets"]) find(id).checked = Boolean(header[id]);
    this.history = header.history && new History(header.history, (w) => this.chooseWorld(w));
    const first = this.worlds[0];
    this.panel.set("trail", first.n > 60 ? "1" : "Infinity");
    this.panel.set("layout", header.layout);
    this.plots = [...document.querySelectorAll(".plot")].map((box, k) => new Plot(box, header.signals[k], (time) => this.seek(time)));
    this.names = new Names();
    this.legend = new Legend();
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
    this.arrangement.replace(header.scenes);
    this.begin(header);
    this.time = 0;
    this.actors.restart();
    this.panel.describe(header.title, this);
    this.changed();
  }

  /** More of a flight that is running. */
  append(rows) {
    const [world] = this.worlds;
    world.append(rows);
    this.end = world.end;
    this.span = Math.max(this.span, this.end);
    this.actors.extend();
    if (!this.arrangement.within(rows.pos)) this.arrangement.outdated = true; // the camera has to see more
    if (this.arrangement.outdated || performance.now() > (this.painted ?? 0) + (this.stage.hurried ? SELDOM : REPAINT)) {
      this.painted = performance.now();
      this.changed();
    }
    this.stage.dirty = true;
  }

  /** The flight is over, or it cannot be heard of any more. */
  finish() {
    if (!this.running) return;
    this.running = this.following = false;
    this.span = this.end;
    this.arrangement.outdated = true;
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
    this.arrangement.update(panel, this);
    this.actors.fleet.size = panel.size;
    for (const plot of this.plots) plot.look(world, panel.drone, (i) => this.colors(panel.world, i), this.span);
    this.pose(scratch.p, scratch.q);
    if (this.history) this.showPolicy(world);
    if (stage.mode !== panel.mode) stage.setMode(panel.mode, scratch.p, (panel.size || 1) * this.arm);
    this.names.label(this);
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

  /** Pose of the drone that is looked at. */
  pose(pos, quat) {
    const { panel } = this, world = this.worlds[panel.world], [row, share] = world.at(this.time);
    const there = world.position(row, share, panel.drone, pos);
    pos.add(this.arrangement.layout[panel.world].offset);
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
    const { panel, stage, time } = this;
    if (this.pose(scratch.p, scratch.q)) stage.track(scratch.p, scratch.q, (panel.size || 1) * this.arm);
    if (panel.mode !== "board") stage.orbit.update(); // which turns the camera to its own target
    this.actors.show(time, passed, panel, this.arrangement.layout);
    stage.render();
    this.legend.show(this);
    if (!stage.hurried || this.frames % 2 === 0) this.names.follow(this);
    if (!stage.hurried || this.frames % 4 === 0) {
      for (const plot of this.plots) plot.draw(time);
      this.images.show(this.worlds[panel.world], panel.drone, time);
      panel.showTime(time, this.span, this.playing, this.following);
    }
    this.frames++;
  }
}
