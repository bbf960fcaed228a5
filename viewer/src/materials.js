// What obstacles look as if they were made of: brown cylinders have bark, boxes of a bright color are banded as gates are.

import { MeshLambertMaterial } from "three";

const BARK = `
float wood = step(1.6 * vColor.b, vColor.r), turn = atan(at.y, at.x), across = length(at.xy);
float ridges = sin(9.0 * turn + 2.0 * sin(4.0 * at.z)) * sin(17.0 * turn - 3.0 * sin(2.3 * at.z) + 1.0);
diffuseColor.rgb *= across > 0.97 ? 1.25 + 0.45 * wood * ridges : 1.6 + 0.25 * wood * sin(30.0 * across);`;
const BANDS = `
vec3 sorted = size.x > size.y ? (size.x > size.z ? size : size.zyx) : size.y > size.z ? size.yxz : size.zyx;
float along = size.x > size.y ? (size.x > size.z ? at.x : at.z) : size.y > size.z ? at.y : at.z;
float bright = step(0.5, max(vColor.r, max(vColor.g, vColor.b)) - min(vColor.r, min(vColor.g, vColor.b)));
float band = abs(fract(along / (2.0 * max(sorted.y, sorted.z))) - 0.5) - 0.25, soft = fwidth(band);
diffuseColor.rgb = mix(diffuseColor.rgb, vec3(0.85), bright * smoothstep(-soft, soft, -band));`;
const PATTERNS = { Cylinder: BARK, Box: BANDS };

/** The material of obstacles of a kind, with this opacity. In its patterns `at` is where a point of an obstacle is, m, and `size` the obstacle's size. */
export function materialOf(kind, opacity) {
  const clear = opacity < 1, material = new MeshLambertMaterial({ transparent: clear, opacity, depthWrite: !clear });
  if (!PATTERNS[kind] || clear) return material;
  const at = kind === "Box" ? "position * size" : "vec3(position.xy, position.z * size.z)"; // a cylinder is looked at in radii
  material.onBeforeCompile = (shader) => {
    shader.vertexShader = shader.vertexShader
      .replace("#include <common>", "#include <common>\nvarying vec3 at; varying vec3 size;")
      .replace("#include <begin_vertex>", `#include <begin_vertex>
        size = vec3(length(instanceMatrix[0].xyz), length(instanceMatrix[1].xyz), length(instanceMatrix[2].xyz));
        at = ${at};`);
    shader.fragmentShader = shader.fragmentShader
      .replace("#include <common>", "#include <common>\nvarying vec3 at; varying vec3 size;")
      .replace("#include <color_fragment>", `#include <color_fragment>${PATTERNS[kind]}`);
  };
  material.customProgramCacheKey = () => kind;
  return material;
}
