// Names in the view: of drones above them, and of worlds that stand side by side. One that would cover another moves up.

const NAMED = 24; // drones in a world of which all have their names in the view
const HEIGHT = 19; // pixels of a name
const find = (id) => document.getElementById(id);

export class Names {
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

  /** Put every name where `at(label)` says, in pixels, or hide it where that is null. */
  place(at) {
    const taken = [], placed = this.labels.map((label) => ({ label, spot: at(label) }));
    placed.sort((a, b) => (b.spot?.[1] ?? 0) - (a.spot?.[1] ?? 0));
    for (const { label: { element, width }, spot } of placed) {
      element.hidden = !spot;
      if (!spot) continue;
      let [x, y] = spot;
      const covers = (other) => Math.abs(x - other.x) < (width + other.width) / 2 + 2 && Math.abs(y - other.y) < HEIGHT - 0.5; // pixels, beyond rounding
      for (let other; (other = taken.find(covers)); ) y = other.y - HEIGHT;
      taken.push({ x, y, width });
      const transform = `translate(${Math.round(x)}px, ${Math.round(y - 4)}px) translate(-50%, -100%)`;
      if (element.style.transform !== transform) element.style.transform = transform;
    }
  }
}

/** The drones of a world whose names are shown. */
export const named = (world, chosen) => (world.n > NAMED ? [chosen] : world.labels.map((_, i) => i));
