// Where each world is drawn, with the obstacles around it, and what the camera is fitted to.

import { Vector3 } from "three";
import { armOf, bounds } from "./flight.js";
import { solids } from "./solids.js";

const MARGIN = 2; // arms of the largest drone, which the camera shows around the flight
const ROOM = 0.2; // share of its extent that a flight that is running may grow to every side before the camera moves

export class Arrangement {
  constructor(stage, worlds, scenes) {
    Object.assign(this, { stage, worlds });
    this.replace(scenes);
  }

  /** Other obstacles. */
  replace(scenes) {
    for (const scene of this.surroundings ?? []) for (const group of scene.groups) this.stage.scene.remove(group);
    this.surroundings = scenes.map((scene) => ({ ...scene, groups: [] }));
    this.outdated = true;
  }

  get ground() {
    return this.surroundings.some((scene) => scene.ground);
  }

  /** Whether positions are in the box that the camera was fitted to. */
  within(pos) {
    const { low, high } = this.fitted, inside = (x, k) => !(x < low[k] - 1e-3 || x > high[k] + 1e-3);
    return pos.every((x, k) => inside(x, k % 3));
  }

  /** Arrange anew what is outdated or was chosen; `player` says whether the flight is running, live, or of a training. */
  update(panel, player) {
    const key = `${panel.layout} ${panel.layout === "grid" ? "" : panel.world}`;
    if (!this.outdated && this.key === key) return;
    Object.assign(this, { key, outdated: false });
    this.lay(panel, player);
  }

  lay(panel, { running, live, history }) {
    const { worlds, stage, surroundings } = this, mode = worlds.length > 1 ? panel.layout : "ghosts", grid = mode === "grid";
    const seen = history ? [worlds[history.kept]] : worlds;
    const { low, high, points: corners } = bounds(seen, surroundings), span = high.clone().sub(low), columns = Math.ceil(Math.sqrt(worlds.length));
    const [dx, dy] = [1.25 * Math.max(span.x, 0.5), 1.25 * Math.max(span.y, 0.5)];
    stage.margin = MARGIN * Math.max(...seen.flatMap(({ kinds }) => kinds.map(armOf)));
    this.sideBySide = grid;
    this.top = low.clone().add(high).multiplyScalar(0.5).setZ(high.z);
    this.layout = worlds.map((_, w) => ({
      offset: grid ? new Vector3((w % columns) * dx, -Math.floor(w / columns) * dy, 0) : new Vector3(),
      ghost: mode === "ghosts" && w !== panel.world,
      hidden: mode === "alone" && w !== panel.world,
    }));
    const obstacles = this.surround(grid ? worlds : [worlds[panel.world]]);
    const last = this.layout[worlds.length - 1].offset, wide = this.layout[Math.min(columns, worlds.length) - 1].offset;
    if (running) {
      const room = span.clone().multiplyScalar(ROOM);
      corners.push(low.sub(room).clone(), high.add(room).clone());
    }
    this.fitted = { low: low.toArray(), high: high.toArray() };
    low.z = this.ground ? Math.min(low.z, 0) : low.z;
    const points = this.layout.flatMap(({ offset }) => corners.map((point) => point.clone().add(offset)));
    if (grid) stage.fit(low.clone().setY(low.y + last.y), high.clone().setX(high.x + wide.x), this.ground, obstacles, points);
    else stage.fit(low, high, this.ground, obstacles, points, live || history);
  }

  /** Put the obstacles around some worlds; those that can be seen through are not in the result. */
  surround(worlds) {
    const { stage, surroundings } = this, obstacles = [];
    for (const scene of surroundings) for (const group of scene.groups.splice(0)) stage.scene.remove(group);
    for (const world of worlds) {
      const scene = surroundings[world.scene], group = solids(scene);
      obstacles.push(...group.children.filter((mesh) => !mesh.material.transparent));
      group.position.copy(this.layout[world.index].offset);
      scene.groups.push(group);
      stage.scene.add(group);
    }
    return obstacles;
  }
}
