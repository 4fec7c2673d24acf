// Vectors are arrays of three numbers. Rotations are arrays of nine, row by row; those of cameras
// have the rows right, down and forward, in the axes of the page (right, up, back).

const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const subtract = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const scaled = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const length = a => Math.hypot(...a);
const unit = a => scaled(a, 1 / Math.max(length(a), 1e-12));
const mixed = (a, b, t) => a.map((value, i) => value + (b[i] - value) * t);
const cross = (a, b) =>
  [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const row = (R, i) => R.slice(3 * i, 3 * i + 3);

/** Rotate a vector. */
const rotated = (R, v) => [0, 1, 2].map(i => dot(row(R, i), v));

/** Rotate a vector by the inverse of a rotation. */
const rotatedBack = (R, v) => [0, 1, 2].map(i => R[i] * v[0] + R[3 + i] * v[1] + R[6 + i] * v[2]);

/** Turn a vector around a unit axis by an angle in radians. */
function turned(v, axis, angle) {
  const c = Math.cos(angle), along = scaled(axis, dot(axis, v) * (1 - c));
  return add(add(scaled(v, c), scaled(cross(axis, v), Math.sin(angle))), along);
}

/** Quaternion wxyz of a rotation. */
function quaternionOf(R) {
  const [a, b, c, d, e, f, g, h, i] = R;
  const squares = [1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i];
  const rows = [
    [squares[0], h - f, c - g, d - b], [h - f, squares[1], b + d, c + g],
    [c - g, b + d, squares[2], f + h], [d - b, c + g, f + h, squares[3]],
  ];
  const q = rows[squares.indexOf(Math.max(...squares))];
  return q.map(value => value / Math.hypot(...q));
}

/** Rotation of a unit quaternion wxyz. */
function rotationOf([w, x, y, z]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

/** Rotation on the way from one to another: the shorter way, t from 0 to 1. */
function rotationBetween(from, to, t) {
  const p = quaternionOf(from), q = quaternionOf(to);
  const side = p.reduce((sum, value, i) => sum + value * q[i], 0) < 0 ? -1 : 1;
  const angle = Math.acos(Math.min(1, Math.abs(p.reduce((s, value, i) => s + value * q[i], 0))));
  const weight = share => angle < 1e-4 ? share : Math.sin(share * angle) / Math.sin(angle);
  const sum = p.map((value, i) => weight(1 - t) * value + side * weight(t) * q[i]);
  return rotationOf(sum.map(value => value / Math.hypot(...sum)));
}
