// The flight in the page: a JSON header and arrays, compressed with zlib, in base64 (see payload.py).

const TYPES = { i2: Int16Array, f4: Float32Array, u1: Uint8Array };

/** The header of the payload, with an array in place of every reference to one. */
export async function decode(base64) {
  const bytes = await inflate(fromBase64(base64));
  const length = new DataView(bytes.buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + length)));
  return resolved(header, bytes.buffer, 4 + length);
}

function fromBase64(text) {
  const binary = atob(text.trim());
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

function resolved(value, buffer, start) {
  if (Array.isArray(value)) return value.map((x) => resolved(x, buffer, start));
  if (value === null || typeof value !== "object") return value;
  if ("dtype" in value) return array(value, buffer, start);
  return Object.fromEntries(Object.entries(value).map(([name, x]) => [name, resolved(x, buffer, start)]));
}

/** An array in row-major order; int16 counts steps from `low`, and holds differences along the first axis. */
function array({ dtype, offset, shape, low, step }, buffer, start) {
  const size = shape.reduce((a, b) => a * b, 1);
  const Type = TYPES[dtype];
  const data = new Type(buffer.slice(start + offset, start + offset + size * Type.BYTES_PER_ELEMENT));
  if (dtype === "u1") return { data, shape };
  if (dtype === "f4") return data;
  const row = shape.length ? size / shape[0] : 1;
  for (let i = row; i < size; i++) data[i] += data[i - row]; // modulo 2^16, as they were made
  const columns = low.length;
  const values = new Float32Array(size);
  for (let i = 0; i < size; i++) values[i] = low[i % columns] + step[i % columns] * (data[i] + 32768);
  return values;
}
