// Gaussians of a run: SPZ, version 3, with numbers of 8 to 24 bits, packed by gzip. One thing differs:
// a centre that equals the one before is not there, as periods share centres. A bit says which.

const PER_GEOMETRY = 16;  // Numbers of a Gaussian: centre, opacity, covariance (6), colour (3), none
const PER_SH = 60;  // Bytes of a Gaussian: 15 coefficients of red, green, blue and none

/** Bytes of a text in base64. */
function bytesOf(text) {
  const characters = atob(text), bytes = new Uint8Array(characters.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = characters.charCodeAt(i);
  return bytes;
}

/** Unpack what gzip has packed. */
async function unpack(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

const bitOf = (bits, i) => bits[i >> 3] >> (7 - (i & 7)) & 1;

/** Read the header and find the arrays that follow it. `repeated` is one bit for each Gaussian. */
function partsOf(bytes, repeated) {
  const head = new DataView(bytes.buffer, bytes.byteOffset, 16);
  const [magic, version, count] = [0, 4, 8].map(at => head.getUint32(at, true));
  if (magic !== 0x5053474e || version !== 3) throw new Error("the Gaussians are not SPZ version 3");
  const degree = head.getUint8(12), perSh = 3 * ((degree + 1) ** 2 - 1);
  const sizes = { opacities: 1, colors: 3, scales: 3, rotations: 4, sh: perSh };
  const parts = { count, perSh, fraction: 2 ** -head.getUint8(13) };
  parts.centres = new Uint8Array(9 * count);
  let at = 16;
  for (let i = 0; i < count; i++) {
    if (!bitOf(repeated, i)) at += 9;
    parts.centres.set(bytes.subarray(at - 9, at), 9 * i);
  }
  for (const [name, size] of Object.entries(sizes)) {
    parts[name] = bytes.subarray(at, at += size * count);
  }
  return parts;
}

/** Rotation of a quaternion whose largest number is left out; the others have 9 bits and a sign. */
function packedRotation(bytes, at) {
  let bits = bytes[at] | bytes[at + 1] << 8 | bytes[at + 2] << 16 | bytes[at + 3] << 24;
  const largest = bits >>> 30, xyzw = [0, 0, 0, 0];
  let rest = 1;
  for (let i = 3; i >= 0; i--) {
    if (i === largest) continue;
    xyzw[i] = (bits & 511) / 511 * Math.SQRT1_2 * (bits & 512 ? -1 : 1);
    rest -= xyzw[i] ** 2;
    bits >>>= 10;
  }
  xyzw[largest] = Math.sqrt(Math.max(rest, 0));
  return rotationOf([xyzw[3], xyzw[0], xyzw[1], xyzw[2]]);
}

/** Write R diag(variances) R^T: its upper half, row by row. */
function writeCovariance(target, at, R, variances) {
  for (let i = 0; i < 3; i++) {
    for (let j = i; j < 3; j++) {
      target[at++] = R[3 * i] * R[3 * j] * variances[0] + R[3 * i + 1] * R[3 * j + 1] * variances[1]
        + R[3 * i + 2] * R[3 * j + 2] * variances[2];
    }
  }
}

/** Decode Gaussians: numbers for the shaders, in rows of PER_GEOMETRY and PER_SH. */
async function decodeGaussians({ spz, repeated }) {
  const [bytes, bits] = await Promise.all([spz, repeated].map(text => unpack(bytesOf(text))));
  const parts = partsOf(bytes, bits), { count, perSh } = parts;
  const geometry = new Float32Array(count * PER_GEOMETRY);
  const sh = new Uint8Array(count * PER_SH).fill(128);  // 128 is 0
  for (let i = 0; i < count; i++) {
    const at = i * PER_GEOMETRY, variances = [0, 0, 0];
    for (let j = 0; j < 3; j++) {
      const from = 9 * i + 3 * j, bytes = parts.centres;
      const fixed = (bytes[from] << 8 | bytes[from + 1] << 16 | bytes[from + 2] << 24) >> 8;
      geometry[at + j] = fixed * parts.fraction;
      variances[j] = Math.exp(2 * (parts.scales[3 * i + j] / 16 - 10));
      geometry[at + 10 + j] = (parts.colors[3 * i + j] / 255 - 0.5) / 0.15;
    }
    geometry[at + 3] = parts.opacities[i] / 255;
    writeCovariance(geometry, at + 4, packedRotation(parts.rotations, 4 * i), variances);
    for (let j = 0; j < perSh; j++) {
      sh[PER_SH * i + 4 * (j / 3 | 0) + j % 3] = parts.sh[perSh * i + j];
    }
  }
  return { count, geometry, sh };
}

/** Numbers of the Gaussians of one period: one bit for each Gaussian of the file. */
async function decodeMembers(text, count) {
  const bits = await unpack(bytesOf(text)), members = [];
  for (let i = 0; i < count; i++) if (bitOf(bits, i)) members.push(i);
  return Uint32Array.from(members);
}
