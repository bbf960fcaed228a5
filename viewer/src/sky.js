// The sky: a dome about the camera, from the haze at the horizon to the zenith.

import { BackSide, BufferAttribute, Color, Mesh, MeshBasicMaterial, SphereGeometry } from "three";
import { theme } from "./theme.js";

const RINGS = 32;
const HAZY = 0.9; // exponent of the height: how quickly the haze thins above the horizon

export function sky() {
  const geometry = new SphereGeometry(1, 12, RINGS).rotateX(Math.PI / 2), { position } = geometry.attributes;
  const haze = new Color(theme.haze), zenith = new Color(theme.zenith), colors = new Float32Array(3 * position.count);
  for (let v = 0; v < position.count; v++)
    haze.clone().lerp(zenith, Math.max(0, position.getZ(v)) ** HAZY).toArray(colors, 3 * v);
  geometry.setAttribute("color", new BufferAttribute(colors, 3));
  const dome = new Mesh(geometry, new MeshBasicMaterial({ vertexColors: true, side: BackSide, fog: false, depthWrite: false }));
  dome.renderOrder = 1; // after all that hides it
  dome.frustumCulled = false;
  dome.onBeforeRender = (renderer, scene, camera) => {
    const radius = 0.9 * camera.far;
    dome.matrixWorld.makeScale(radius, radius, radius).setPosition(camera.position);
    dome.modelViewMatrix.multiplyMatrices(camera.matrixWorldInverse, dome.matrixWorld);
  };
  return dome;
}
