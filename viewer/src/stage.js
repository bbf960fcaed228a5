// Renderer, lights, sky, ground, and the three cameras: orbit, follow, on board.

import { Box3, DirectionalLight, Fog, HemisphereLight, PerspectiveCamera, Scene, Vector2, Vector3, WebGLRenderer } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { Ground } from "./ground.js";
import { ObstacleShadows } from "./shadows.js";
import { sky } from "./sky.js";
import { theme } from "./theme.js";

const SUN = new Vector3(-0.45, -0.35, 1); // direction, behind the camera
const SHADED = 1.8; // how far shadows of obstacles are drawn, over the radius of the flight
const VIEW = new Vector3(-0.62, -0.72, 0.34).normalize(); // from the middle of the flight to the camera
const LOW = 0.3; // height above the ground, over its extent, up to which a flight is shown with its shadows
const SLOWEST = 1 / 32; // s a frame may take before the resolution falls
const COARSEST = 0.25; // of the full resolution
const SETTLING = 3; // frames after a change that are not counted

/** Whether there is no graphics processor. */
function drawnInSoftware() {
  const context = document.createElement("canvas").getContext("webgl2"), info = context?.getExtension("WEBGL_debug_renderer_info");
  const name = context && info ? context.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

/** The nearest of 1, 2 and 5 times a power of ten. */
function round(x) {
  const power = 10 ** Math.floor(Math.log10(x));
  return power * [1, 2, 5, 10].reduce((best, y) => (Math.abs(Math.log((y * power) / x)) < Math.abs(Math.log((best * power) / x)) ? y : best));
}

export class Stage {
  constructor(canvas) {
    this.canvas = canvas;
    this.software = drawnInSoftware();
    const quick = { antialias: !this.software, desynchronized: this.software, powerPreference: "high-performance" };
    const context = canvas.getContext("webgl2", { alpha: false, stencil: false, ...quick }); // opaque: no need to mix it with the page
    this.renderer = new WebGLRenderer({ canvas, context });
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(45, 1, 0.01, 1000);
    this.camera.up.set(0, 0, 1);
    this.pixels = new Vector2(1, 1);
    this.margin = 0; // m, which the camera shows around the points of the flight
    this.share = 1; // of the full resolution, while playing
    this.sharp = true; // whether the picture stands still and is drawn in full resolution
    this.slow = 0; // s, a frame took on average
    this.waited = 0; // frames since the resolution changed
    this.mode = "orbit";
    this.orbit = new OrbitControls(this.camera, canvas);
    this.orbit.maxPolarAngle = 0.98 * Math.PI;
    this.orbit.addEventListener("start", () => (this.moved = true));
    this.orbit.addEventListener("change", () => (this.dirty = true));
    const sun = new DirectionalLight(0xfff4e2, 1.9);
    sun.position.copy(SUN);
    this.shadows = new ObstacleShadows(this.renderer, [SUN.x / SUN.z, SUN.y / SUN.z]);
    this.ground = new Ground(this.shadows.texture);
    this.scene.add(sky(), this.ground, sun, new HemisphereLight(...theme.hemisphere, 1.6));
  }

  /** Fit the ground and the shadows of obstacles to a box, and the camera to points in it, unless it is to stay where a user has moved it. */
  fit(low, high, ground, obstacles, points, stay) {
    this.points = points;
    this.middle = low.clone().add(high).multiplyScalar(0.5);
    this.radius = Math.max(0.25, low.distanceTo(high) / 2);
    const { middle, radius } = this;
    this.camera.near = radius / 200;
    this.camera.far = 60 * radius;
    this.scene.fog = new Fog(theme.haze, 8 * radius, 28 * radius);
    this.orbit.maxDistance = 20 * radius;
    this.orbit.minDistance = radius / 100;
    this.cell = round(radius / 2);
    this.hasGround = this.ground.visible = ground;
    this.hasObstacles = obstacles.length > 0;
    this.ground.lay(middle, radius, this.cell, SHADED * radius, obstacles.length > 0);
    if (ground && obstacles.length) this.shadows.draw(obstacles, middle, SHADED * radius);
    if (!stay || (!this.moved && this.mode === "orbit")) this.home();
  }

  /** Put the camera at a point, with another in the middle of the picture. */
  look(eye, target) {
    this.camera.position.set(...eye);
    this.orbit.target.set(...target);
  }

  /** The camera that shows all of the flight. */
  home() {
    const right = new Vector3(0, 0, 1).cross(VIEW).normalize(), up = VIEW.clone().cross(right), p = new Vector3();
    const box = new Box3().setFromPoints(this.points), middle = box.getCenter(new Vector3()), points = [...this.points];
    if (this.hasGround && box.min.z < LOW * box.min.distanceTo(box.max)) {
      points.push(middle.clone().setZ(0)); // where the shadows are
      middle.z = Math.min(box.min.z, 0) / 2 + box.max.z / 2;
    }
    const tall = Math.tan((45 * Math.PI) / 360), wide = tall * this.camera.aspect;
    let away = 0;
    for (const point of points) {
      p.subVectors(point, middle);
      const [x, y] = [right, up].map((axis) => Math.abs(p.dot(axis)) + this.margin);
      away = Math.max(away, Math.max(x / wide, y / tall) + p.dot(VIEW));
    }
    away = Math.max(1.25 * away, 0.3 * this.radius);
    this.camera.position.copy(middle).addScaledVector(VIEW, away);
    this.orbit.target.copy(middle);
    this.orbit.update();
    this.moved = false;
    this.dirty = true;
  }

  /** Choose `orbit`, `follow` or `board`. */
  setMode(mode, pos, arm) {
    this.camera.up.set(0, 0, 1);
    this.orbit.enabled = mode !== "board";
    if (mode === "follow") {
      const away = this.mode === "follow" ? this.camera.position.clone().sub(this.orbit.target).length() : 10 * arm;
      this.camera.position.copy(pos).addScaledVector(VIEW, away);
      this.orbit.target.copy(pos);
    } else if (mode === "orbit" && this.mode !== "orbit") this.home();
    this.camera.fov = mode === "board" ? 75 : 45;
    this.camera.updateProjectionMatrix();
    this.mode = mode;
    this.dirty = true;
  }

  /** Move the camera with the drone that is looked at. */
  track(pos, quat, arm) {
    if (this.mode === "follow") {
      this.camera.position.add(pos.clone().sub(this.orbit.target));
      this.orbit.target.copy(pos);
    } else if (this.mode === "board") {
      const forward = new Vector3(1, 0, 0).applyQuaternion(quat);
      this.camera.up.set(0, 0, 1).applyQuaternion(quat);
      this.camera.position.copy(pos).addScaledVector(this.camera.up, 0.5 * arm).addScaledVector(forward, 0.6 * arm);
      this.camera.lookAt(forward.add(this.camera.position));
    }
    this.camera.near = this.mode === "orbit" ? this.radius / 200 : Math.min(this.radius / 200, 0.3 * arm);
    this.camera.updateProjectionMatrix();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    const smooth = this.software && this.sharp ? 2 : 1; // instead of antialiasing, which is slow in software
    const ratio = Math.min(2, window.devicePixelRatio * (this.sharp ? smooth : this.share));
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.renderer.getDrawingBufferSize(this.pixels);
    this.pixels.divideScalar(ratio * 1); // ribbons are as wide at any resolution
    this.dirty = true;
  }

  /** Draw in full resolution, or in that at which frames are quick enough. */
  setSharp(sharp) {
    if (this.sharp === sharp) return;
    this.sharp = sharp;
    this.slow = this.waited = 0;
    this.resize();
  }

  /** Pixels that are drawn for one of the screen, along each side. */
  get detail() {
    return this.sharp ? 1 : this.share;
  }

  /** Pixels of the screen of 1 m at a point, at least. */
  magnification(point) {
    return this.canvas.clientHeight / 2 / Math.tan((this.camera.fov * Math.PI) / 360) / point.distanceTo(this.camera.position);
  }

  /** Whether everything but the drones may be drawn less often. */
  get hurried() {
    return !this.sharp && this.share < 0.7;
  }

  /** Lower the resolution while frames take too long, and raise it again when they do not. */
  adapt(seconds) {
    if (this.sharp) return this.setSharp(false);
    this.waited++;
    if (this.waited <= SETTLING) return;
    this.slow += (seconds - this.slow) / Math.min(this.waited - SETTLING, 12);
    const change = Math.sqrt((0.85 * SLOWEST) / this.slow), share = Math.max(COARSEST, Math.min(1, this.share * Math.max(0.5, change)));
    const coarser = this.slow > SLOWEST && this.waited > SETTLING + 4, finer = this.slow < 0.6 * SLOWEST && this.waited > 90;
    if ((coarser || finer) && Math.abs(share - this.share) > 0.03) {
      this.share = share;
      this.slow = this.waited = 0;
      this.resize();
    }
  }

  render() {
    this.renderer.render(this.scene, this.camera);
    this.dirty = false;
  }

  /** Where a point is on the canvas, CSS pixels; null behind the camera. */
  project(point) {
    const p = point.clone().project(this.camera);
    if (p.z > 1 || p.z < -1) return null;
    return [((p.x + 1) / 2) * this.canvas.clientWidth, ((1 - p.y) / 2) * this.canvas.clientHeight];
  }
}
