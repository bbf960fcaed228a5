// The shape of a vehicle, from where its rotors are and how large they are.

import { BoxGeometry, BufferAttribute, Color, ConeGeometry, CylinderGeometry, PlaneGeometry, RingGeometry } from "three";
import { armOf } from "./flight.js";
import { mergeGeometries } from "three/examples/jsm/utils/BufferGeometryUtils.js";

const BODY = new Color(1, 1, 1), FRAME = new Color(0.09, 0.09, 0.1), NOSE = new Color(1, 1, 1), BLADE = new Color(0.1, 0.1, 0.1);
const PLAIN = 0.82; // brightness of the body, whose color is that of the drone
const SIDES = 20; // of a disc

// In all of these `rotor` names the rotor that a vertex turns with (0: none), and `hub` is the place of its axis.

/** Body, arms, motors and blades. */
export function fine(vehicle) {
  const arm = armOf(vehicle), radius = vehicle.prop_radius, thickness = 0.09 * arm;
  const parts = [
    part(cylinder(0.36 * arm, 0.2 * arm, 20), BODY, PLAIN),
    part(beam(0.22 * arm, 0.1 * arm, 0.1 * arm).translate(0.4 * arm, 0, 0.02 * arm), NOSE),
    part(beam(0.42 * arm, 0.3 * arm, 0.16 * arm).translate(-0.02 * arm, 0, 0.16 * arm), FRAME),
  ];
  vehicle.rotor_pos.forEach(([x, y, z], k) => {
    const top = z + 0.12 * arm, height = Math.max(0.16 * arm, Math.abs(z)), hub = [x, y];
    parts.push(spoke(beam(Math.hypot(x, y), thickness, 0.7 * thickness), hub, arm));
    parts.push(part(cylinder(0.12 * arm, height, 10).translate(x, y, top - height / 2), BODY, 0.7));
    parts.push(part(beam(2 * radius, 0.16 * radius, 0.03 * radius).translate(x, y, top + 0.02 * arm), BLADE, 1, k + 1, hub));
  });
  return mergeGeometries(parts);
}

/** The same with few triangles. */
export function plain(vehicle) {
  const arm = armOf(vehicle), radius = vehicle.prop_radius;
  const nose = new ConeGeometry(0.12 * arm, 0.3 * arm, 3, 1, true).rotateZ(-Math.PI / 2).translate(0.5 * arm, 0, 0);
  const parts = [part(beam(0.7 * arm, 0.6 * arm, 0.24 * arm), BODY, PLAIN), part(nose, NOSE)];
  vehicle.rotor_pos.forEach(([x, y, z], k) => {
    parts.push(spoke(strip(Math.hypot(x, y), 0.14 * arm), [x, y], arm));
    parts.push(part(strip(2 * radius, 0.3 * radius).translate(x, y, z + 0.14 * arm), BLADE, 1, k + 1, [x, y]));
  });
  return mergeGeometries(parts);
}

/** A few pixels: a body on a cross. */
export function coarse(vehicle) {
  const arm = armOf(vehicle), parts = [part(strip(0.9 * arm, 0.9 * arm).translate(0, 0, 0.1 * arm), BODY, PLAIN)];
  vehicle.rotor_pos.slice(0, 2).forEach(([x, y, z], k) => {
    const [u, v, w] = vehicle.rotor_pos[k + 2], cross = strip(Math.hypot(x - u, y - v) + vehicle.prop_radius, vehicle.prop_radius);
    parts.push(part(cross.rotateZ(Math.atan2(y - v, x - u)).translate((x + u) / 2, (y + v) / 2, (z + w) / 2), FRAME));
  });
  return mergeGeometries(parts);
}

/** A pixel or two. */
export function dot(vehicle) {
  const arm = armOf(vehicle);
  return part(strip(1.5 * arm, 1.5 * arm).rotateZ(Math.PI / 4).translate(0, 0, 0.1 * arm), BODY, PLAIN);
}

const beam = (length, width, height) => new BoxGeometry(length, width, height);
const strip = (length, width) => new PlaneGeometry(length, width);

/** An arm from the middle to a rotor; those in front are in the color of the drone. */
function spoke(geometry, [x, y], arm) {
  const turned = geometry.translate(Math.hypot(x, y) / 2, 0, 0).rotateZ(Math.atan2(y, x)), front = x > 0.1 * arm;
  return part(turned, front ? BODY : FRAME, front ? PLAIN : 1);
}

/**
 * The discs that the blurred blades of rotors are seen as: denser towards the tips, and along the two blades, so that
 * one sees them turn. Of the colors only the opacity counts.
 */
export function discs(vehicle) {
  const arm = armOf(vehicle), shades = [0.35, 0.5, 0.75];
  return mergeGeometries(
    vehicle.rotor_pos.map(([x, y, z], k) => {
      const disc = part(new RingGeometry(0, vehicle.prop_radius, SIDES, shades.length - 1), BODY, 1, k + 1, [x, y]), colors = [];
      for (const shade of shades)
        for (let side = 0; side <= SIDES; side++) colors.push(1, 1, 1, shade * (0.62 + 0.38 * Math.cos((4 * Math.PI * side) / SIDES)));
      return disc.translate(x, y, z + 0.15 * arm).setAttribute("color", new BufferAttribute(new Float32Array(colors), 4));
    }),
  );
}

/** A square around a shadow of radius 1; its colors are places in it. */
export function shadow() {
  const square = part(strip(2, 2), BODY), { array } = square.attributes.position;
  const places = [0, 1, 2, 3].flatMap((v) => [array[3 * v], array[3 * v + 1], 0, 1]);
  return square.setAttribute("color", new BufferAttribute(new Float32Array(places), 4));
}

function cylinder(radius, height, sides) {
  return new CylinderGeometry(radius, radius, height, sides).rotateX(Math.PI / 2);
}

function part(geometry, color, brightness = 1, rotor = 0, hub = [0, 0]) {
  const count = geometry.attributes.position.count;
  geometry.deleteAttribute("uv");
  geometry.setAttribute("color", filled(count, [color.r * brightness, color.g * brightness, color.b * brightness]));
  geometry.setAttribute("rotor", filled(count, [rotor]));
  geometry.setAttribute("hub", filled(count, hub));
  return geometry;
}

function filled(count, values) {
  const data = new Float32Array(count * values.length);
  for (let i = 0; i < data.length; i++) data[i] = values[i % values.length];
  return new BufferAttribute(data, values.length);
}
