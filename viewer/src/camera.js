// The images of the on-board cameras, where they were recorded; depth in colors.

import { short } from "./plots.js";

const NEAR_TO_FAR = ["#fde725", "#7ad151", "#22a884", "#2a788e", "#414487", "#440154"]; // viridis
const COLORS = Array.from({ length: 256 }, (_, level) => {
  const place = ((255 - level) / 255) * (NEAR_TO_FAR.length - 1), k = Math.min(NEAR_TO_FAR.length - 2, Math.floor(place));
  const [low, high] = [k, k + 1].map((i) => [1, 3, 5].map((at) => parseInt(NEAR_TO_FAR[i].slice(at, at + 2), 16)));
  return low.map((x, c) => x + (place - k) * (high[c] - x));
});

export class CameraImages {
  constructor(box) {
    this.box = box;
  }

  /** The images of a drone as they are at a time. */
  show(world, drone, time) {
    this.box.hidden = !world.images.length;
    while (this.box.children.length < world.images.length) this.add();
    world.images.forEach((images, k) => {
      const figure = this.box.children[k];
      let frame = images.t.findIndex((t) => t > time + 1e-6) - 1;
      if (frame === -2) frame = images.t.length - 1;
      const key = `${world.index} ${drone} ${Math.max(0, frame)}`;
      if (figure.dataset.shown === key) return;
      figure.dataset.shown = key;
      paint(figure.firstChild, images.frames, Math.max(0, frame), drone);
      const range = images.farthest ? `, 0 (yellow) to ${short(images.farthest)} m` : "";
      const caption = `${images.name} of ${world.labels[drone]}${range}`;
      figure.lastChild.textContent = caption;
      figure.firstChild.setAttribute("aria-label", `Image of the on-board camera: ${caption}`);
    });
    [...this.box.children].forEach((figure, k) => (figure.hidden = k >= world.images.length));
  }

  add() {
    const figure = document.createElement("figure"), canvas = document.createElement("canvas");
    canvas.setAttribute("role", "img");
    figure.append(canvas, document.createElement("figcaption"));
    this.box.append(figure);
  }
}

function paint(canvas, { data, shape }, frame, drone) {
  const [, n, height, width, channels] = shape;
  const start = (frame * n + drone) * height * width * channels;
  const image = new ImageData(width, height);
  for (let i = 0; i < width * height; i++) {
    const at = start + channels * i;
    for (let c = 0; c < 3; c++) image.data[4 * i + c] = channels > 1 ? data[at + c] : COLORS[data[at]][c];
    image.data[4 * i + 3] = 255;
  }
  [canvas.width, canvas.height] = [width, height];
  canvas.getContext("2d").putImageData(image, 0, 0);
}
