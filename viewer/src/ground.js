// The ground: a grid and grain from one small texture, the shadows of the obstacles, haze in the distance. It fills most
// of the picture, so that it has a shader of its own with few operations: nothing moves on it but the shadows of drones.

import {
  CanvasTexture, Color, LinearMipmapLinearFilter, Mesh, PlaneGeometry, RepeatWrapping, ShaderMaterial, Vector2,
} from "three";
import { theme } from "./theme.js";

const TILE = 512, SQUARES = 2; // pixels of the texture, and squares of the grid in it, along each side
const LINE = 3; // pixels
const FINE = 8, COARSE = 12; // differences of neighboring pixels, and of patches of grass, of 255
const BRIGHT = 230; // of 255, on average

const VERTEX = `
varying vec2 place; varying vec2 away;
void main() {
  vec4 world = modelMatrix * vec4(position, 1.0);
  place = world.xy;
  away = world.xy - cameraPosition.xy;
  gl_Position = projectionMatrix * viewMatrix * world;
}`;
const FRAGMENT = `
uniform sampler2D tile; uniform sampler2D shadows; uniform vec3 color; uniform vec3 haze; uniform vec2 middle; uniform vec2 scale; uniform float fading;
varying vec2 place; varying vec2 away;
void main() {
  float light = texture2D(tile, place * scale.x).r;
  #ifdef SHADED
  light *= 1.0 - texture2D(shadows, (place - middle) * scale.y + 0.5).r;
  #endif
  float far = dot(away, away) * fading;
  gl_FragColor = vec4(mix(color * light, haze, far / (far + 1.0)), 1.0);
}`;

/** Some squares of the grid: lines and grain. */
function tile() {
  const canvas = document.createElement("canvas"), context = canvas.getContext("2d"), patches = 16;
  canvas.width = canvas.height = TILE;
  const image = context.createImageData(TILE, TILE), rough = Array.from({ length: patches * patches }, () => Math.random() - 0.5);
  const smooth = (x) => x * x * (3 - 2 * x), at = (i, j) => rough[(j % patches) * patches + (i % patches)];
  for (let y = 0; y < TILE; y++)
    for (let x = 0; x < TILE; x++) {
      const u = (patches * x) / TILE, v = (patches * y) / TILE, i = Math.floor(u), j = Math.floor(v), s = smooth(u - i), t = smooth(v - j);
      const patch = (at(i, j) * (1 - s) + at(i + 1, j) * s) * (1 - t) + (at(i, j + 1) * (1 - s) + at(i + 1, j + 1) * s) * t;
      const line = Math.min(x % (TILE / SQUARES), y % (TILE / SQUARES)) < LINE ? 0.76 : 1;
      image.data.fill(line * (BRIGHT + COARSE * patch + FINE * (Math.random() - 0.5)), 4 * (y * TILE + x), 4 * (y * TILE + x) + 3);
      image.data[4 * (y * TILE + x) + 3] = 255;
    }
  context.putImageData(image, 0, 0);
  const texture = new CanvasTexture(canvas);
  texture.wrapS = texture.wrapT = RepeatWrapping;
  texture.minFilter = LinearMipmapLinearFilter;
  return texture;
}

export class Ground extends Mesh {
  constructor(shadows) {
    const bytes = (color) => new Color(color).convertLinearToSRGB();
    super(
      new PlaneGeometry(2, 2),
      new ShaderMaterial({
        vertexShader: VERTEX, fragmentShader: FRAGMENT,
        uniforms: {
          tile: { value: tile() }, shadows: { value: shadows }, color: { value: bytes(theme.ground) }, haze: { value: bytes(theme.haze) },
          middle: { value: new Vector2() }, scale: { value: new Vector2() }, fading: { value: 0 },
        },
      }),
    );
  }

  /** Lay squares of `cell` m, with haze from `radius` m on, and the picture of the shadows, if any, `reach` m to every side. */
  lay(middle, radius, cell, reach, shaded) {
    const { uniforms } = this.material;
    this.position.set(middle.x, middle.y, 0);
    this.scale.setScalar(60 * radius);
    uniforms.middle.value.set(middle.x, middle.y);
    uniforms.scale.value.set(1 / SQUARES / cell, 0.5 / reach);
    uniforms.fading.value = (14 * radius) ** -2;
    if (shaded) this.material.defines.SHADED = 1;
    else delete this.material.defines.SHADED;
    this.material.needsUpdate = true;
  }
}
