// Copies of a small shape in one mesh. Renderers in software draw instances one after the other, each as slowly as a mesh.

import { BufferAttribute, BufferGeometry, DynamicDrawUsage, Mesh } from "three";

/** A mesh with the methods of an InstancedMesh that the fleet uses. */
export class Batch extends Mesh {
  constructor(shape, material, capacity) {
    const vertices = shape.attributes.position.count, corners = shape.index.array, index = new Uint32Array(corners.length * capacity);
    for (let k = 0; k < capacity; k++) for (let c = 0; c < corners.length; c++) index[k * corners.length + c] = k * vertices + corners[c];
    const geometry = new BufferGeometry();
    geometry.setIndex(new BufferAttribute(index, 1));
    for (const name of ["position", "color"])
      geometry.setAttribute(name, new BufferAttribute(new Float32Array(3 * vertices * capacity), 3).setUsage(DynamicDrawUsage));
    super(geometry, material);
    Object.assign(this, { vertices, corners: corners.length, capacity, count: 0, matrices: new Float32Array(16 * capacity) });
    this.shape = { position: shape.attributes.position.array, color: shape.attributes.color.array };
    this.frustumCulled = false;
  }

  setMatrixAt(k, matrix) {
    const m = matrix.toArray(this.matrices, 16 * k), at = 16 * k, from = this.shape.position, to = this.geometry.attributes.position.array;
    for (let v = 0, out = 3 * this.vertices * k; v < from.length; v += 3, out += 3)
      for (let axis = 0; axis < 3; axis++)
        to[out + axis] = m[at + axis] * from[v] + m[at + 4 + axis] * from[v + 1] + m[at + 8 + axis] * from[v + 2] + m[at + 12 + axis];
  }

  getMatrixAt(k, matrix) {
    matrix.fromArray(this.matrices, 16 * k);
  }

  setColorAt(k, { r, g, b }) {
    const from = this.shape.color, to = this.geometry.attributes.color.array;
    for (let v = 0, out = 3 * this.vertices * k; v < from.length; v += 3, out += 3)
      [to[out], to[out + 1], to[out + 2]] = [r * from[v], g * from[v + 1], b * from[v + 2]];
  }

  /** Draw the copies before `count`, as they are now. */
  update() {
    this.geometry.setDrawRange(0, this.corners * this.count);
    for (const attribute of Object.values(this.geometry.attributes)) sent(attribute, this.vertices * this.count);
  }
}

/** Send the first `count` entries of an attribute to the renderer. */
export function sent(attribute, count) {
  attribute.clearUpdateRanges();
  attribute.addUpdateRange(0, attribute.itemSize * count);
  attribute.needsUpdate = count > 0;
}
