// A view: {eye, rotation, camera, distance}. The camera has the width, height and intrinsics of a
// photo in pixels; its image is fitted into the canvas. Turning goes around the point at `distance`.

/** Intrinsics in pixels of a canvas into which the image of a camera just fits. */
function pixelsOf(camera, width, height) {
  const s = Math.min(width / camera.width, height / camera.height);
  return {
    fx: camera.fx * s,
    fy: camera.fy * s,
    cx: camera.cx * s + (width - camera.width * s) / 2,
    cy: camera.cy * s + (height - camera.height * s) / 2,
  };
}

/** Project a point: x and y in pixels, and depth. */
function projected(view, width, height, point) {
  const K = pixelsOf(view.camera, width, height);
  const [x, y, z] = rotated(view.rotation, subtract(point, view.eye));
  return [K.fx * x / z + K.cx, K.fy * y / z + K.cy, z];
}

/** Point at some depth behind a pixel. */
function unprojected(view, width, height, x, y, depth) {
  const K = pixelsOf(view.camera, width, height);
  const ray = [(x - K.cx) / K.fx * depth, (y - K.cy) / K.fy * depth, depth];
  return add(view.eye, rotatedBack(view.rotation, ray));
}

const pivotOf = view => add(view.eye, scaled(row(view.rotation, 2), view.distance));

/** Rotate all three axes of a camera around an axis of the page. */
const turnedRotation = (R, axis, angle) =>
  [0, 1, 2].flatMap(i => turned(row(R, i), axis, angle));

/** Circle around the point in the middle: to the side around `up`, and up or down. */
function orbited(view, up, aside, above) {
  const pivot = pivotOf(view), steepness = Math.asin(Math.max(-1, Math.min(1,
    dot(row(view.rotation, 2), up))));
  // Straight up and down the sides would change places.
  const limit = Math.PI / 2 - 0.02;
  const change = Math.max(-limit, Math.min(limit, steepness + above)) - steepness;
  let R = turnedRotation(view.rotation, row(view.rotation, 0), change);
  R = turnedRotation(R, up, aside);
  return { ...view, rotation: R, eye: subtract(pivot, scaled(row(R, 2), view.distance)) };
}

/** Look around without moving. */
function looked(view, up, aside, above) {
  const R = turnedRotation(view.rotation, row(view.rotation, 0), above);
  return { ...view, rotation: turnedRotation(R, up, aside) };
}

/** Move by shares of the distance: to the right, down, forward. */
function moved(view, right, down, forward) {
  const step = rotatedBack(view.rotation, scaled([right, down, forward], view.distance));
  return { ...view, eye: add(view.eye, step) };
}

/** Get nearer to the point in the middle, or farther from it. */
function zoomed(view, factor) {
  const distance = view.distance * factor, forward = row(view.rotation, 2);
  return { ...view, distance, eye: subtract(pivotOf(view), scaled(forward, distance)) };
}

/** View on the way from one to another, t from 0 to 1. */
function viewBetween(from, to, t) {
  const s = t * t * (3 - 2 * t), camera = {};
  for (const key of Object.keys(to.camera)) {
    // Relative to the size, so that images of two sizes can be mixed.
    camera[key] = from.camera[key] + (to.camera[key] - from.camera[key]) * s;
  }
  return {
    eye: mixed(from.eye, to.eye, s),
    rotation: rotationBetween(from.rotation, to.rotation, s),
    distance: from.distance + (to.distance - from.distance) * s,
    camera,
  };
}
