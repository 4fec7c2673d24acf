// Lines over the picture: cameras as frusta, the wipe, what is measured.

const TEST_COLOR = "#ffd24a", TRAIN_COLOR = "#8fd3ff", MEASURE_COLOR = "#ff5d8f";
const NEAREST = 1e-3;  // Part of the distance below which lines are cut

/** Line from one point to another on the canvas; what is behind the viewer is cut off. */
function line3d(context, view, size, from, to) {
  const near = NEAREST * view.distance, depth = p => dot(row(view.rotation, 2),
    subtract(p, view.eye));
  let [a, b] = [from, to], [za, zb] = [depth(a), depth(b)];
  if (za < near && zb < near) return;
  if (za < near) a = mixed(a, b, (near - za) / (zb - za));
  if (zb < near) b = mixed(b, a, (near - zb) / (za - zb));
  const [p, q] = [a, b].map(point => projected(view, ...size, point));
  context.moveTo(p[0], p[1]);
  context.lineTo(q[0], q[1]);
}

/** Corners of the image of a camera, in space at some depth. */
function corners(frame, depth) {
  const { width, height } = frame.camera, view = { ...frame, distance: 1 };
  return [[0, 0], [width, 0], [width, height], [0, height]].map(([x, y]) =>
    unprojected(view, width, height, x, y, depth));
}

function drawFrustum(context, view, size, frame, depth) {
  const ring = corners(frame, depth);
  context.beginPath();
  ring.forEach((corner, i) => {
    line3d(context, view, size, frame.eye, corner);
    line3d(context, view, size, corner, ring[(i + 1) % 4]);
  });
  context.stroke();
}

/** Draw frusta; `marked` is the one under the mouse. */
function drawFrusta(context, view, size, frames, depth, marked) {
  for (const frame of frames) {
    context.strokeStyle = frame.split === "test" ? TEST_COLOR : TRAIN_COLOR;
    context.lineWidth = frame === marked ? 3.5 : 1.3;
    context.globalAlpha = frame === marked ? 1 : 0.8;
    drawFrustum(context, view, size, frame, depth);
  }
  context.globalAlpha = 1;
}

/** Frame whose frustum is at a pixel of the page, the nearest one; null if there is none. */
function frameAt(view, size, frames, depth, x, y, reach) {
  let best = null, bestDepth = Infinity;
  for (const frame of frames) {
    const middle = add(frame.eye, scaled(row(frame.rotation, 2), depth / 2));
    const [px, py, z] = projected(view, ...size, middle);
    if (z <= NEAREST * view.distance || z >= bestDepth) continue;
    const K = pixelsOf(view.camera, ...size), radius = Math.max(reach, 0.4 * K.fx * depth / z);
    if (Math.hypot(px - x, py - y) < radius) [best, bestDepth] = [frame, z];
  }
  return best;
}

/** Text on a dark plate. */
function label(context, text, x, y) {
  context.font = "600 14px system-ui, sans-serif";
  const width = context.measureText(text).width + 14;
  const left = Math.max(4, Math.min(x - width / 2, context.canvas.clientWidth - width - 4));
  context.fillStyle = "rgba(12, 14, 18, .85)";
  context.fillRect(left, y - 28, width, 24);
  context.fillStyle = "#fff";
  context.fillText(text, left + 7, y - 11);
}

/** Draw the points that were clicked and the line between them. */
function drawMeasure(context, view, size, points, text) {
  context.strokeStyle = context.fillStyle = MEASURE_COLOR;
  context.lineWidth = 2.5;
  if (points.length === 2) {
    context.beginPath();
    line3d(context, view, size, points[0], points[1]);
    context.stroke();
  }
  const shown = points.map(p => projected(view, ...size, p)).filter(([, , z]) => z > 0);
  for (const [x, y] of shown) {
    context.beginPath();
    context.arc(x, y, 5, 0, 2 * Math.PI);
    context.fill();
  }
  if (shown.length === 2) {
    label(context, text, (shown[0][0] + shown[1][0]) / 2, (shown[0][1] + shown[1][1]) / 2);
  }
}

function drawWipe(context, [width, height], share) {
  const x = share * width, y = height / 2;
  context.fillStyle = "#fff";
  context.fillRect(x - 1, 0, 2, height);
  context.beginPath();
  context.arc(x, y, 15, 0, 2 * Math.PI);
  context.fill();
  context.fillStyle = "#14171c";
  context.font = "600 17px system-ui, sans-serif";
  context.textAlign = "center";
  context.fillText("↔", x, y + 6);
  context.textAlign = "start";
}

/** Outline of a photo within the canvas. */
function drawOutline(context, view, [width, height]) {
  const { camera } = view, s = Math.min(width / camera.width, height / camera.height);
  const [w, h] = [camera.width * s, camera.height * s];
  context.strokeStyle = "rgba(255, 255, 255, .7)";
  context.lineWidth = 1;
  context.strokeRect((width - w) / 2 + 0.5, (height - h) / 2 + 0.5, w - 1, h - 1);
}
