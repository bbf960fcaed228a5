// All that moves with the flights: drones, trails, arrows, loads, downwash, and the error between two flights.

import { Arrows } from "./arrows.js";
import { Fleet } from "./fleet.js";
import { Jets } from "./jets.js";
import { Loads } from "./loads.js";
import { comparable, Ribbon } from "./ribbon.js";
import { Trail } from "./trails.js";
import { PathVectors } from "./vectors.js";

export class Actors {
  /** `colors(w, i)` is the color of drone i of world w. */
  constructor(stage, worlds, vehicles, colors) {
    this.stage = stage;
    this.fleet = new Fleet(stage, worlds, vehicles, colors);
    this.trails = worlds.map((world, w) => new Trail(stage, world, (i) => colors(w, i)));
    this.arrows = worlds.map((world, w) => new Arrows(stage, world, (i) => colors(w, i)));
    this.loads = worlds.map((world) => new Loads(stage, world));
    this.jets = new Jets(stage, worlds);
    this.vectors = worlds.filter(({ arrows }) => arrows).map((world) => new PathVectors(stage, world));
    this.ribbon = comparable(worlds) ? new Ribbon(stage, worlds) : null;
  }

  /** Learn of more rows of a flight that is running. */
  extend() {
    for (const trail of this.trails) trail.extend();
  }

  /** Show another flight of the same team. */
  restart() {
    for (const trail of this.trails) trail.restart();
  }

  /** Whether the error between two flights is shown: they are in the same place. */
  compared(panel) {
    return Boolean(this.ribbon) && panel.shown.error && panel.layout === "ghosts";
  }

  /** Show a time, `passed` seconds after the last; `layout` says where each world is drawn. */
  show(time, passed, panel, layout) {
    const { shown } = panel;
    this.fleet.place(time, passed, layout, panel.mode === "board" ? panel : null);
    this.trails.forEach((trail, w) => trail.show(time, panel.trail, layout[w], this.stage));
    this.arrows.forEach((arrows, w) => arrows.show(time, shown, layout[w], this.fleet));
    this.loads.forEach((loads, w) => loads.show(time, layout[w], this.fleet));
    this.jets.show(time, shown.jets, layout);
    for (const vectors of this.vectors) vectors.show(layout[vectors.world.index]);
    this.ribbon?.show(time, panel.trail, this.compared(panel));
  }
}
