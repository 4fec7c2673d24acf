// Where a ray meets what is drawn.

/** Point that a pixel shows, or null: where half of the light has been stopped.
 *  `set` is a set of Gaussians, of which `geometry` has the numbers (see spz.js). */
function pick(set, view, width, height, x, y) {
  const K = { ...pixelsOf(view.camera, width, height), width, height };
  const ray = [(x - K.cx) / K.fx, (y - K.cy) / K.fy, 1];
  const hits = [];
  for (const i of set.members) {
    const hit = hitOf(set, i, view, K, x, y, ray);
    if (hit) hits.push(hit);
  }
  hits.sort((a, b) => a.order - b.order);
  let light = 1;
  for (const { alpha, depth } of hits) {
    light *= 1 - alpha;
    if (light < 0.5) return unprojected(view, width, height, x, y, depth);
  }
  return null;
}

/** Opacity of a Gaussian at a pixel and depth of the ray's densest point in it; null if outside. */
function hitOf(set, i, view, K, x, y, ray) {
  const g = set.geometry, at = PER_GEOMETRY * i;
  const p = rotated(view.rotation, subtract([g[at], g[at + 1], g[at + 2]], view.eye));
  if (p[2] < set.near) return null;
  const dx = x - K.fx * p[0] / p[2] - K.cx, dy = y - K.fy * p[1] / p[2] - K.cy;
  // Variances of the page bound those of the image: most Gaussians are far from the ray.
  const spread = Math.max(g[at + 4] + g[at + 7] + g[at + 9], 0) * (K.fx / p[2]) ** 2;
  const slant = 1 + (p[0] ** 2 + p[1] ** 2) / p[2] ** 2;
  if (dx * dx + dy * dy > 12 * (spread * slant + 1)) return null;
  const S = cameraCovariance(g, at + 4, view.rotation);
  const [A, B, C] = imageCovariance(S, p, K), before = Math.max(A * C - B * B, 0);
  const [a, c] = [A + 0.3, C + 0.3], after = a * c - B * B;
  const opacity = g[at + 3] * (set.antialiased ? Math.sqrt(before / after) : 1);
  const alpha = opacity * Math.exp(-0.5 * (c * dx * dx - 2 * B * dx * dy + a * dy * dy) / after);
  return alpha < 1 / 255 ? null : { alpha, depth: peakDepth(S, p, ray), order: p[2] };
}

/** Covariance in the axes of the camera, as six numbers: the upper half, row by row. */
function cameraCovariance(g, at, R) {
  const [a, b, c, d, e, f] = g.subarray(at, at + 6);
  const times = v => [
    a * v[0] + b * v[1] + c * v[2], b * v[0] + d * v[1] + e * v[2], c * v[0] + e * v[1] + f * v[2],
  ];
  const rows = [0, 1, 2].map(i => row(R, i)), products = rows.map(times);
  return [[0, 0], [0, 1], [0, 2], [1, 1], [1, 2], [2, 2]].map(([i, j]) =>
    dot(rows[i], products[j]));
}

/** Covariance in pixels, with the linearisation of the shader. */
function imageCovariance([a, b, c, d, e, f], [x, y, z], { fx, fy, cx, cy, width, height }) {
  const held = (slope, middle, size, focal) => Math.max(-(middle + 0.15 * size) / focal,
    Math.min((1.15 * size - middle) / focal, slope));
  const u = -held(x / z, cx, width, fx), v = -held(y / z, cy, height, fy);
  return [
    (a + 2 * u * c + u * u * f) * (fx / z) ** 2,
    (b + v * c + u * e + u * v * f) * fx * fy / z ** 2,
    (d + 2 * v * e + v * v * f) * (fy / z) ** 2,
  ];
}

/** Depth at which a ray is in the densest place of a Gaussian at p: a tilted disk is hit in its
 *  plane, not at the depth of its centre. */
function peakDepth([a, b, c, d, e, f], p, ray) {
  // Inverse of the covariance up to its determinant, which cancels.
  const inverse = [
    [d * f - e * e, c * e - b * f, b * e - c * d],
    [c * e - b * f, a * f - c * c, b * c - a * e],
    [b * e - c * d, b * c - a * e, a * d - b * b],
  ];
  const weighted = inverse.map(values => dot(values, ray)), reach = 3 * Math.sqrt(f);
  const depth = dot(weighted, p) / dot(weighted, ray);
  return depth > p[2] - reach && depth < p[2] + reach ? depth : p[2];
}
