// Renderer, lights, ground with shadows, and the three cameras: orbit, follow, on board.

import {
  BasicShadowMap, Color, DirectionalLight, Fog, HemisphereLight, Mesh, MeshLambertMaterial, PCFShadowMap, PerspectiveCamera, PlaneGeometry, Scene,
  Vector2, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

const SKY = 0xdfe8f0, GROUND = 0xf1efe9;
const VIEW = new Vector3(-0.62, -0.72, 0.45).normalize(); // from the middle of the flight to the camera
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

/** A material of the ground with lines every `cell` m, darker every ten; they fade where they would be too dense. */
function ruled(material, cell) {
  material.onBeforeCompile = (shader) => {
    shader.uniforms.cell = { value: cell };
    shader.vertexShader = shader.vertexShader
      .replace("#include <common>", "#include <common>\nvarying vec2 place;")
      .replace("#include <begin_vertex>", "#include <begin_vertex>\nplace = (modelMatrix * vec4(position, 1.0)).xy;");
    shader.fragmentShader = shader.fragmentShader
      .replace("#include <common>", `#include <common>
        varying vec2 place; uniform float cell;
        float ruling(vec2 x, vec2 wide) {
          vec2 near = abs(fract(x - 0.5) - 0.5) / wide;
          return clamp(1.3 - min(near.x, near.y), 0.0, 1.0) * clamp(1.15 - 3.0 * max(wide.x, wide.y), 0.0, 1.0);
        }`)
      .replace("#include <color_fragment>", `#include <color_fragment>
        vec2 square = place / cell, wide = fwidth(square);
        diffuseColor.rgb *= 1.0 - max(0.12 * ruling(square, wide), 0.25 * ruling(0.1 * square, 0.1 * wide));`);
  };
  return material;
}

export class Stage {
  constructor(canvas) {
    this.canvas = canvas;
    this.software = drawnInSoftware();
    this.renderer = new WebGLRenderer({ canvas, antialias: !this.software, powerPreference: "high-performance" });
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = this.software ? BasicShadowMap : PCFShadowMap;
    this.scene = new Scene();
    this.scene.background = new Color(SKY);
    this.camera = new PerspectiveCamera(45, 1, 0.01, 1000);
    this.camera.up.set(0, 0, 1);
    this.pixels = new Vector2(1, 1);
    this.share = 1; // of the full resolution, while playing
    this.sharp = true; // whether the picture stands still and is drawn in full resolution
    this.slow = 0; // s, a frame took on average
    this.drawn = 0; // frames
    this.waited = 0; // frames since the resolution changed
    this.mode = "orbit";
    this.orbit = new OrbitControls(this.camera, canvas);
    this.orbit.maxPolarAngle = 0.98 * Math.PI;
    this.orbit.addEventListener("start", () => (this.moved = true));
    this.orbit.addEventListener("change", () => (this.dirty = true));
    this.scene.add(new HemisphereLight(0xffffff, 0xb9c0c6, 1.7));
    this.sun = new DirectionalLight(0xffffff, 1.7);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.setScalar(this.software ? 1024 : 2048);
    this.sun.shadow.radius = 2;
    this.scene.add(this.sun, this.sun.target);
  }

  /** Fit ground and light to a box, and the camera to points in it, unless it is to stay where a user has moved it. */
  fit(low, high, ground, points, stay) {
    this.points = points;
    this.middle = low.clone().add(high).multiplyScalar(0.5);
    this.radius = Math.max(0.25, low.distanceTo(high) / 2);
    const { middle, radius } = this;
    this.camera.near = radius / 200;
    this.camera.far = 60 * radius;
    this.scene.fog = new Fog(SKY, 8 * radius, 28 * radius);
    this.orbit.maxDistance = 20 * radius;
    this.orbit.minDistance = radius / 100;
    this.light(middle, radius);
    if (this.ground) this.scene.remove(this.ground);
    if (ground) this.addGround(Math.ceil(30 * radius));
    if (!stay || (!this.moved && this.mode === "orbit")) this.home();
  }

  /** Let shadows be sharp about a point. */
  light(middle, radius) {
    this.sun.position.copy(middle).add(new Vector3(0.35, -0.25, 1).normalize().multiplyScalar(4 * radius));
    this.sun.target.position.copy(middle);
    const reach = 1.25 * radius;
    Object.assign(this.sun.shadow.camera, { left: -reach, right: reach, top: reach, bottom: -reach, near: radius, far: 8 * radius });
    this.sun.shadow.camera.updateProjectionMatrix();
    this.sun.shadow.normalBias = radius / 400;
  }

  /** Put the camera at a point, with another in the middle of the picture. */
  look(eye, target) {
    this.camera.position.set(...eye);
    this.orbit.target.set(...target);
    this.light(this.orbit.target, 0.7 * this.camera.position.distanceTo(this.orbit.target));
  }

  addGround(size) {
    this.cell = round(this.radius / 2);
    this.ground = new Mesh(new PlaneGeometry(2 * size, 2 * size), ruled(new MeshLambertMaterial({ color: GROUND }), this.cell));
    this.ground.receiveShadow = true;
    this.ground.position.set(this.middle.x, this.middle.y, 0);
    this.scene.add(this.ground);
  }

  /** The camera that shows all of the flight. */
  home() {
    const right = new Vector3(0, 0, 1).cross(VIEW).normalize(), up = VIEW.clone().cross(right);
    const tall = Math.tan((45 * Math.PI) / 360), wide = tall * this.camera.aspect;
    let away = 0;
    for (const point of this.points) {
      const p = point.clone().sub(this.middle);
      away = Math.max(away, Math.max(Math.abs(p.dot(right)) / wide, Math.abs(p.dot(up)) / tall) + p.dot(VIEW));
    }
    this.camera.position.copy(this.middle).addScaledVector(VIEW, Math.max(1.25 * away, 0.3 * this.radius));
    this.orbit.target.copy(this.middle);
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
    this.renderer.shadowMap.autoUpdate = !this.hurried;
    this.renderer.shadowMap.needsUpdate = this.drawn++ % 3 === 0;
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
