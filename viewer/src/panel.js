// Buttons, keys and the time line: what the user chose, and telling the player when it changes.

export const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4, 8];
const KEYS = [
  ["space", "play, pause"], ["← →", "one step back, forward; with shift ten"], ["home end", "start, end"], ["↑ ↓", "faster, slower"],
  ["1 2 3", "orbit, follow, on board"], ["n p", "next, previous drone"], ["w", "next world"], ["g", "other worlds: ghosts, side by side, hidden"],
  ["t", "trail"], ["b", "size of the drones"], ["f", "thrust of the rotors"], ["r", "resultant force and torque, contact force"], ["d", "downwash"], ["e", "error between two flights"], ["o", "targets"], ["l", "names"],
  ["c", "camera back to the start"], ["?", "these keys"],
];

const find = (id) => document.getElementById(id);

export class Panel {
  /** `player` has `seek`, `toggle`, `step`, `changed`, `home`. */
  constructor(player, flight) {
    this.player = player;
    this.describe(flight.title, flight);
    find("time").addEventListener("input", (event) => player.seek(Number(event.target.value)));
    find("play").addEventListener("click", () => player.toggle());
    find("live").addEventListener("click", () => player.follow());
    for (const speed of SPEEDS) find("speed").add(new Option(`× ${speed}`, speed));
    find("speed").value = 1;
    flight.worlds.forEach((world, w) => find("world").add(new Option(world.name, w)));
    for (const box of document.querySelectorAll(".worlds")) box.hidden = flight.worlds.length < 2;
    document.querySelector(".error").hidden = !flight.actors.ribbon;
    for (const box of document.querySelectorAll(".targets")) box.hidden = !flight.worlds.some((world) => world.targets);
    this.listDrones(flight.worlds[0]);
    for (const id of ["speed", "drone", "layout", "trail", "size", "thrust", "wrench", "jets", "error", "targets", "names"])
      find(id).addEventListener("change", () => player.changed());
    find("world").addEventListener("change", () => {
      this.listDrones(flight.worlds[this.world]);
      player.changed();
    });
    for (const button of document.querySelectorAll("[data-mode]")) button.addEventListener("click", () => this.setMode(button.dataset.mode));
    find("keys").addEventListener("click", () => this.help());
    find("help").innerHTML = `<table>${KEYS.map(([key, text]) => `<tr><td><kbd>${key}</kbd></td><td>${text}</td></tr>`).join("")}</table>`;
    document.addEventListener("keydown", (event) => this.key(event));
  }

  get speed() { return Number(find("speed").value); }
  get drone() { return Number(find("drone").value); }
  get world() { return Number(find("world").value); }
  get layout() { return find("layout").value; }
  get trail() { return Number(find("trail").value); }
  get size() { return Number(find("size").value); }
  get mode() { return document.querySelector('[data-mode][aria-pressed="true"]').dataset.mode; }
  get shown() {
    return Object.fromEntries(["thrust", "wrench", "jets", "error", "targets", "names"].map((id) => [id, find(id).checked]));
  }

  /** Show the title, the length of the time line, and whether the flight is running. */
  describe(title, { span, running }) {
    find("title").textContent = title;
    find("time").max = span;
    find("live").hidden = !running;
  }

  set(id, value) { find(id).value = value; }

  setWorld(w, world) {
    this.set("world", w);
    this.listDrones(world);
  }

  listDrones(world) {
    const chosen = Math.min(this.drone || 0, world.n - 1);
    find("drone").replaceChildren(...world.labels.map((label, i) => new Option(label, i)));
    find("drone").value = chosen;
  }

  setMode(mode) {
    for (const button of document.querySelectorAll("[data-mode]")) button.setAttribute("aria-pressed", button.dataset.mode === mode);
    this.player.changed();
  }

  help() {
    const hidden = (find("help").hidden = !find("help").hidden);
    find("keys").setAttribute("aria-expanded", !hidden);
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const inSelect = event.target.tagName === "SELECT", inTime = event.target.id === "time";
    if (inSelect) return; // a list has keys of its own
    const onButton = event.target.tagName === "BUTTON" || event.target.type === "checkbox";
    const steps = event.shiftKey ? 10 : 1;
    const actions = {
      ArrowLeft: () => this.player.step(-steps), ArrowRight: () => this.player.step(steps),
      ArrowUp: () => this.cycle("speed", 1, false), ArrowDown: () => this.cycle("speed", -1, false),
      Home: () => this.player.seek(0), End: () => this.player.seek(Infinity),
      1: () => this.setMode("orbit"), 2: () => this.setMode("follow"), 3: () => this.setMode("board"),
      n: () => this.cycle("drone", 1), p: () => this.cycle("drone", -1), w: () => this.cycle("world", 1), g: () => this.cycle("layout", 1),
      t: () => this.cycle("trail", 1), b: () => this.cycle("size", 1), f: () => find("thrust").click(), r: () => find("wrench").click(),
      d: () => find("jets").click(), e: () => find("error").click(), o: () => find("targets").click(), l: () => find("names").click(), c: () => this.player.home(), "?": () => this.help(),
      Escape: () => find("help").hidden || this.help(),
    };
    if (!(onButton && event.key === " ")) actions[" "] = () => this.player.toggle();
    const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action) return;
    action();
    if (!inTime || event.key !== "Tab") event.preventDefault();
  }

  cycle(id, by, around = true) {
    const list = find(id), count = list.options.length, next = list.selectedIndex + by;
    list.selectedIndex = around ? (next + count) % count : Math.max(0, Math.min(count - 1, next));
    list.dispatchEvent(new Event("change"));
  }

  showTime(time, end, playing, following) {
    find("live").setAttribute("aria-pressed", following);
    find("time").value = time;
    find("time").setAttribute("aria-valuetext", `${time.toFixed(2)} of ${end.toFixed(2)} seconds`);
    find("clock").value = `${time.toFixed(2)} / ${end.toFixed(2)} s`;
    find("play").textContent = playing ? "❚❚" : "►";
    find("play").setAttribute("aria-label", playing ? "Pause" : "Play");
  }
}
