// Shadows of the obstacles on the ground, drawn once for all frames: obstacles do not move. Shadows of drones are in fleet.js.

import {
  AddEquation, CustomBlending, DoubleSide, MaxEquation, Mesh, OneFactor, OrthographicCamera, PlaneGeometry, ShaderMaterial, Vector2,
  WebGLRenderTarget,
} from "three";

const PIXELS = 1024; // of the picture, along each side
const DARK = 0.45; // share of the light that is lost where an obstacle touches the ground
const SOFT = 2; // pixels between two samples of the blur, seven of which are taken along each axis

const FALLING = `
uniform vec2 middle; uniform float reach; uniform vec2 slope;
varying float height;
void main() {
  vec4 world = vec4(position, 1.0);
  #ifdef USE_INSTANCING
  world = instanceMatrix * world;
  #endif
  world = modelMatrix * world;
  height = max(world.z, 0.0) / reach;
  gl_Position = vec4((world.xy - slope * max(world.z, 0.0) - middle) / reach, 0.0, 1.0);
}`;
const DARKENING = `
varying float height;
void main() { gl_FragColor = vec4(${DARK} / (1.0 + 1.5 * height), 0.0, 0.0, 1.0); }`;
const FLAT = `
varying vec2 at;
void main() { at = uv; gl_Position = vec4(2.0 * uv - 1.0, 0.0, 1.0); }`;
const BLUR = `
uniform sampler2D sharp; uniform vec2 offset;
varying vec2 at;
void main() {
  float sum = 0.0;
  for (int k = -3; k <= 3; k++) sum += (4.0 - abs(float(k))) / 16.0 * texture2D(sharp, at + float(k) * offset).r;
  vec2 edge = step(0.02, min(at, 1.0 - at)); // light beyond the picture
  gl_FragColor = vec4(sum * edge.x * edge.y, 0.0, 0.0, 1.0);
}`;

export class ObstacleShadows {
  /** `slope` is how far a shadow is from what is 1 m high, m. */
  constructor(renderer, slope) {
    this.renderer = renderer;
    const target = () => new WebGLRenderTarget(PIXELS, PIXELS, { depthBuffer: false });
    this.pictures = [target(), target()];
    this.camera = new OrthographicCamera();
    this.falling = new ShaderMaterial({
      vertexShader: FALLING, fragmentShader: DARKENING, side: DoubleSide, depthTest: false, depthWrite: false,
      blending: CustomBlending, blendEquation: MaxEquation, blendEquationAlpha: AddEquation, blendSrc: OneFactor, blendDst: OneFactor,
      uniforms: { middle: { value: new Vector2() }, reach: { value: 1 }, slope: { value: new Vector2(...slope) } },
    });
    const blur = new ShaderMaterial({
      vertexShader: FLAT, fragmentShader: BLUR, depthTest: false, depthWrite: false, uniforms: { sharp: { value: null }, offset: { value: new Vector2() } },
    });
    this.flat = new Mesh(new PlaneGeometry(2, 2), blur);
    this.flat.frustumCulled = false;
  }

  get texture() { return this.pictures[0].texture; }

  /** Draw the shadows of meshes about a point, as far as `reach` m to every side. */
  draw(meshes, middle, reach) {
    const { renderer, pictures: [first, second], falling: { uniforms } } = this;
    uniforms.middle.value.set(middle.x, middle.y);
    uniforms.reach.value = reach;
    this.onto(first, () => meshes.forEach((mesh) => {
      const { material, frustumCulled } = mesh;
      mesh.updateWorldMatrix(true, false);
      Object.assign(mesh, { material: this.falling, frustumCulled: false });
      renderer.render(mesh, this.camera);
      Object.assign(mesh, { material, frustumCulled });
    }));
    this.blur(first, second, SOFT / PIXELS, 0);
    this.blur(second, first, 0, SOFT / PIXELS);
  }

  blur(from, to, x, y) {
    const { uniforms } = this.flat.material;
    uniforms.sharp.value = from.texture;
    uniforms.offset.value.set(x, y);
    this.onto(to, () => this.renderer.render(this.flat, this.camera));
  }

  onto(target, draw) {
    const { renderer } = this;
    renderer.setRenderTarget(target);
    renderer.setClearColor(0x000000, 1);
    renderer.clear();
    renderer.autoClear = false;
    draw();
    renderer.autoClear = true;
    renderer.setRenderTarget(null);
  }
}
