// The page: decodes the flight and begins to play it, or listens to a program that flies it.

import { handles } from "./handles.js";
import { decode } from "./payload.js";
import { Player } from "./player.js";
import { Plant, Simulation } from "./simulation.js";

const find = (id) => document.getElementById(id);

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
