// The note in the view: colors, the grid, and how much larger than they are drones are drawn.

import { CONTACT, FORCE, THRUST, TORQUE } from "./arrows.js";
import { JET } from "./jets.js";
import { short } from "./plots.js";
import { ERROR } from "./ribbon.js";
import { VECTOR } from "./vectors.js";

const find = (id) => document.getElementById(id);

export class Legend {
  show({ actors, arrangement, panel, stage, time, worlds }) {
    const rows = [], row = (color, text) => rows.push(`<i style="background:${color}"></i>${text}`);
    if (panel.shown.thrust) row(THRUST, "thrust of a rotor");
    if (panel.shown.wrench) row(FORCE, "resultant force") && row(TORQUE, "resultant torque");
    if (panel.shown.wrench && worlds.some(({ contacts }) => contacts)) row(CONTACT, "contact force");
    if (panel.shown.targets && worlds[panel.world].targets) rows.push(worlds[panel.world].n > 1 ? "◇ targets, in the colors of the drones" : "◇ target");
    if (actors.vectors.length) row(VECTOR, "vectors along the path");
    if (actors.compared(panel)) row(ERROR, `${short(100 * actors.ribbon.distance(time, panel.drone))} cm between the two flights`);
    if (panel.shown.jets) row(JET, "downwash, up to half of the speed on its axis");
    if (stage.cell && arrangement.ground) rows.push(`squares of ${short(stage.cell)} m`);
    const times = Number(actors.fleet.largest.toPrecision(2));
    if (panel.size > 1) rows.push(`drones are drawn ${times} times as large as they are`);
    else if (times > 1) rows.push(`drones are drawn up to ${times} times as large as they are`);
    const text = rows.join("\n");
    if (text !== this.text) find("legend").innerHTML = this.text = text;
  }
}
