// Copies of a small shape in one mesh. Renderers in software draw instances one after the other, each as slowly as a mesh.

import { BufferAttribute, BufferGeometry, DynamicDrawUsage, Mesh } from "three";

const FIRST = 4; // copies that there is room for at first
const STILL = [0, 0, 0, 0]; // angles of rotors

/** Copies of a shape with positions and colors (of 3 or 4 components); it may have normals, and vertices that turn with a rotor. */
export class Batch extends Mesh {
  constructor(shape, material) {
    super(new BufferGeometry(), material);
    const { position, color, normal, rotor, hub } = shape.attributes, lit = material.isMeshLambertMaterial;
    this.shape = { position: position.array, color: color.array, rotor: rotor?.array, hub: hub?.array, ...(lit && { normal: normal.array }) };
    this.channels = color.itemSize;
    this.vertices = position.count;
    this.corners = shape.index.array;
    this.count = this.capacity = 0;
    this.matrices = new Float32Array(0);
    this.frustumCulled = false;
    this.reserve(FIRST);
  }

  /** Make room for so many copies. */
  reserve(capacity) {
    if (capacity <= this.capacity) return;
    const { corners, vertices, geometry: old } = this, geometry = new BufferGeometry(), index = new Uint32Array(corners.length * capacity);
    for (let k = 0; k < capacity; k++) for (let c = 0; c < corners.length; c++) index[k * corners.length + c] = k * vertices + corners[c];
    geometry.setIndex(new BufferAttribute(index, 1));
    for (const name of ["position", "color", "normal"]) {
      if (!this.shape[name]) continue;
      const size = name === "color" ? this.channels : 3, data = new Float32Array(size * vertices * capacity);
      if (old.attributes[name]) data.set(old.attributes[name].array);
      geometry.setAttribute(name, new BufferAttribute(data, size).setUsage(DynamicDrawUsage));
    }
    const matrices = new Float32Array(16 * capacity);
    matrices.set(this.matrices);
    old.dispose();
    Object.assign(this, { geometry, matrices, capacity });
    if (this.twin) this.twin.geometry = geometry;
  }

  /** A mesh of the same copies in another material. */
  in(material) {
    this.twin = new Mesh(this.geometry, material);
    this.twin.frustumCulled = false;
    return this.twin;
  }

  /** Place of a further copy. */
  add() {
    if (this.count === this.capacity) this.reserve(2 * this.capacity);
    return this.count++;
  }

  /** Place a copy, whose rotors are turned by `angles`, rad; not a number: the vertices of a rotor are not drawn. */
  setMatrixAt(k, matrix, angles = STILL) {
    const m = matrix.toArray(this.matrices, 16 * k), at = 16 * k, { position: from, normal, rotor, hub } = this.shape;
    const { position, normal: normals } = this.geometry.attributes, to = position.array;
    const turns = rotor && angles.map((angle) => [Math.cos(angle), Math.sin(angle)]);
    for (let v = 0, out = 3 * this.vertices * k; v < from.length; v += 3, out += 3) {
      let x = from[v], y = from[v + 1], z = from[v + 2];
      if (rotor && rotor[v / 3]) {
        const [c, s] = turns[rotor[v / 3] - 1], i = (2 * v) / 3, u = x - hub[i], w = y - hub[i + 1];
        if (c !== c) [x, y] = [hub[i], hub[i + 1]];
        else [x, y] = [hub[i] + c * u - s * w, hub[i + 1] + s * u + c * w];
      }
      for (let axis = at; axis < at + 3; axis++) to[out + axis - at] = m[axis] * x + m[axis + 4] * y + m[axis + 8] * z + m[axis + 12];
      if (normals)
        for (let axis = at; axis < at + 3; axis++)
          normals.array[out + axis - at] = m[axis] * normal[v] + m[axis + 4] * normal[v + 1] + m[axis + 8] * normal[v + 2];
    }
  }

  getMatrixAt(k, matrix) {
    matrix.fromArray(this.matrices, 16 * k);
  }

  /** Multiply the colors of the shape in a copy. */
  setColorAt(k, { r, g, b }) {
    const from = this.shape.color, to = this.geometry.attributes.color.array;
    for (let v = 0, out = 3 * this.vertices * k; v < from.length; v += 3, out += 3)
      [to[out], to[out + 1], to[out + 2]] = [r * from[v], g * from[v + 1], b * from[v + 2]];
  }

  /** Multiply the colors of a shape with opacity in a copy, and the opacity of every rotor. */
  setTintAt(k, { r, g, b }, opacities) {
    const { color: from, rotor } = this.shape, to = this.geometry.attributes.color.array;
    for (let v = 0, out = 4 * this.vertices * k; v < from.length; v += 4, out += 4)
      [to[out], to[out + 1], to[out + 2], to[out + 3]] = [r * from[v], g * from[v + 1], b * from[v + 2], from[v + 3] * opacities[rotor ? Math.max(0, rotor[v / 4] - 1) : 0]];
  }

  /** Draw the copies, as they are now. */
  update() {
    this.visible = this.count > 0;
    if (this.twin) this.twin.visible = this.visible;
    this.geometry.setDrawRange(0, this.corners.length * this.count);
    for (const attribute of Object.values(this.geometry.attributes)) {
      attribute.clearUpdateRanges();
      attribute.addUpdateRange(0, attribute.itemSize * this.vertices * this.count);
      attribute.needsUpdate = this.count > 0;
    }
  }
}
