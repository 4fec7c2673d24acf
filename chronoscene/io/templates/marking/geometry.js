// Rays and projections of cameras of COLMAP, with the distortion of OpenCV; original pixels.
function distort([x, y], d) {
  const [k1, k2, p1, p2, k3, k4, k5, k6] = d, r = x * x + y * y;
  const radial = (1 + r * (k1 + r * (k2 + r * k3))) / (1 + r * (k4 + r * (k5 + r * k6)));
  return [x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x),
    y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y];
}

// Pixels of a place in the world, or null behind the camera.
function project(camera, world) {
  const [x, y, z] = [0, 1, 2].map(i =>
    camera.pose[i].reduce((sum, v, j) => sum + v * (j < 3 ? world[j] : 1), 0));
  if (z <= 1e-9) return null;
  const [u, v] = distort([x / z, y / z], camera.distortion);
  const [fx, fy, cx, cy] = camera.intrinsics;
  return [fx * u + cx, fy * v + cy];
}

// Centre and direction of the ray of a pixel; the direction has depth 1.
function ray(camera, [px, py]) {
  const [fx, fy, cx, cy] = camera.intrinsics, goal = [(px - cx) / fx, (py - cy) / fy];
  let at = goal.slice();
  for (let i = 0; i < 20; i++) {
    const now = distort(at, camera.distortion);
    at = at.map((v, k) => v + goal[k] - now[k]);
  }
  const turn = v => [0, 1, 2].map(j =>
    camera.pose[0][j] * v[0] + camera.pose[1][j] * v[1] + camera.pose[2][j] * v[2]);
  return { centre: turn(camera.pose.map(row => -row[3])), direction: turn([...at, 1]) };
}

// Place nearest to all rays; null where they are almost parallel.
function intersect(rays) {
  const A = [[0, 0, 0], [0, 0, 0], [0, 0, 0]], b = [0, 0, 0];
  for (const { centre, direction } of rays) {
    const n = Math.hypot(...direction), d = direction.map(v => v / n);
    for (let i = 0; i < 3; i++) for (let j = 0; j < 3; j++) {
      const m = (i === j ? 1 : 0) - d[i] * d[j];
      A[i][j] += m;
      b[i] += m * centre[j];
    }
  }
  const det = m => m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1])
    - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
    + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0]);
  const whole = det(A);
  if (Math.abs(whole) < 1e-4) return null;
  return [0, 1, 2].map(k => det(A.map((row, i) => row.map((v, j) => j === k ? b[i] : v))) / whole);
}
