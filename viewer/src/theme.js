// Colors of the page and of its view, light or dark as the system is when the page is opened.

import { Color } from "three";

const dark = matchMedia("(prefers-color-scheme: dark)").matches;
document.documentElement.dataset.theme = dark ? "dark" : "light";

export const theme = dark
  ? { zenith: 0x0d141d, haze: 0x333e49, ground: 0x2c3338, hemisphere: [0xcfdcea, 0x4a4a46], grid: "#39434c", ink: "#e8edf1", note: "#a9b6c0", target: "#b5bfc8" }
  : { zenith: 0x7fa9d3, haze: 0xe4ebf0, ground: 0xc2cbb4, hemisphere: [0xf4f9ff, 0x8d8f80], grid: "#e1e5e9", ink: "#222222", note: "#55606a", target: "#555555" };

const LIGHTEST = new Color(0xffffff), DARKEST = 0.22; // least luminance of a color on a dark ground

/** A color of the palette that can be seen on the ground of the page. */
export function legible(color) {
  if (!dark) return color;
  const { r, g, b } = new Color(color), luminance = 0.2126 * r + 0.7152 * g + 0.0722 * b;
  const share = Math.max(0, (DARKEST - luminance) / (1 - luminance));
  return `#${new Color(color).lerp(LIGHTEST, share).getHexString()}`;
}
