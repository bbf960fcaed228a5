// The images of the on-board cameras, where they were recorded.

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
      const caption = `${images.name} of ${world.labels[drone]}`;
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
    for (let c = 0; c < 3; c++) image.data[4 * i + c] = data[at + (channels > 1 ? c : 0)];
    image.data[4 * i + 3] = 255;
  }
  [canvas.width, canvas.height] = [width, height];
  canvas.getContext("2d").putImageData(image, 0, 0);
}
