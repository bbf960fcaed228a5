// What scripts and tests of the page use: `window.jaxdrones`.

import { jet } from "./jets.js";

const find = (id) => document.getElementById(id);

export function handles(player) {
  return {
    player,
    jet,
    /** Move to a time, draw, and read the positions back from the scene: [world][drone] = [x, y, z]. */
    positionsAt(time) {
      player.playing = false;
      player.seek(time);
      player.following = false;
      player.draw(0);
      return player.worlds.map((_, w) => player.actors.fleet.positions(w));
    },
    /** Show nothing but the flight and a clock, by a camera; drones are `scale` times as large as they are, if given. */
    async film(mode, scale) {
      player.playing = false;
      player.stage.setSharp(true);
      document.body.classList.add("film");
      await new Promise(requestAnimationFrame);
      player.resize();
      if (scale) player.panel.set("size", scale);
      player.panel.setMode(mode);
      player.stage.home();
    },
    /** Draw one frame, from a point to another if given; it is on the screen when the promise is kept. */
    async frameAt(time, passed, eye, target) {
      player.seek(time);
      if (eye) player.stage.look(eye, target);
      player.draw(passed);
      find("filmclock").textContent = `${time.toFixed(2)} s`;
      await new Promise(requestAnimationFrame);
    },
  };
}
