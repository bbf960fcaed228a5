// Names in the view: of drones above them, and of worlds that stand side by side. One that would cover another
// or the title moves up, or down where there is no room above.

import { scratch } from "./flight.js";
import { theme } from "./theme.js";

const NAMED = 24; // drones in a world of which all have their names in the view
const HEIGHT = 19; // pixels of a name
const ABOVE = 4; // pixels between a name and what it names
const HIGHEST = HEIGHT + ABOVE + 2; // pixels from the top of the picture
const find = (id) => document.getElementById(id);

export class Names {
  /** Choose what has a name in a view: drones of the world that is looked at, and worlds side by side. */
  label({ arrangement, colors, panel, worlds }) {
    const world = worlds[panel.world], drones = panel.shown.names ? named(world, panel.drone) : [];
    const labels = drones.map((drone) => ({ drone, text: world.labels[drone], color: colors(world.index, drone) }));
    if (arrangement.sideBySide && panel.shown.names)
      worlds.forEach(({ name }, w) => labels.push({ point: arrangement.top.clone().add(arrangement.layout[w].offset), text: name, color: theme.note }));
    this.list(labels);
  }

  /** Put the names where their drones are. */
  follow({ actors, arm, arrangement, panel, stage, time, worlds }) {
    const world = worlds[panel.world], [row, share] = world.at(time), { p } = scratch, { offset } = arrangement.layout[panel.world];
    this.place(({ drone, point }) => {
      if (point) return stage.project(point);
      if (!world.position(row, share, drone, p) || (panel.mode === "board" && drone === panel.drone)) return null;
      p.add(offset).setZ(p.z + 1.1 * arm * actors.fleet.scale(world.vehicle[drone], p));
      return stage.project(p);
    });
  }

  /** Names of the drones of a world, by `label`: { text, color, drone } or { text, color, point }. */
  list(labels) {
    this.labels = labels.map((label) => {
      const element = document.createElement("span");
      element.textContent = label.text;
      element.style.borderColor = label.color;
      return { ...label, element };
    });
    find("labels").replaceChildren(...this.labels.map(({ element }) => element));
    for (const label of this.labels) label.width = label.element.offsetWidth;
  }

  /** Put every name where `at(label)` says, in pixels, or hide it where that is null; inside the picture, beside the title. */
  place(at) {
    const placed = this.labels.map((label) => ({ label, spot: at(label) })), picture = find("stage").clientWidth;
    const { offsetLeft, offsetTop, offsetWidth, offsetHeight } = find("title");
    const taken = [{ x: offsetLeft + offsetWidth / 2, y: offsetTop + offsetHeight + ABOVE, width: offsetWidth }];
    placed.sort((a, b) => (b.spot?.[1] ?? 0) - (a.spot?.[1] ?? 0));
    for (const { label: { element, width }, spot } of placed) {
      element.hidden = !spot;
      if (!spot) continue;
      const side = width / 2 + 2, seen = spot[0] >= 0 && spot[0] <= picture && spot[1] >= 0;
      const x = seen ? Math.min(Math.max(spot[0], side), Math.max(side, picture - side)) : spot[0];
      const first = seen ? Math.max(spot[1], HIGHEST) : spot[1];
      const free = (step) => {
        const covers = (other) => Math.abs(x - other.x) < (width + other.width) / 2 + 2 && Math.abs(y - other.y) < HEIGHT - 0.5; // pixels, beyond rounding
        let y = first;
        for (let other; (other = taken.find(covers)); ) y = other.y + step;
        return y;
      };
      let y = free(-HEIGHT);
      if (seen && y < HIGHEST) y = free(HEIGHT);
      taken.push({ x, y, width });
      const transform = `translate(${Math.round(x)}px, ${Math.round(y - ABOVE)}px) translate(-50%, -100%)`;
      if (element.style.transform !== transform) element.style.transform = transform;
    }
  }
}

/** The drones of a world whose names are shown. */
const named = (world, chosen) => (world.n > NAMED ? [chosen] : world.labels.map((_, i) => i));
