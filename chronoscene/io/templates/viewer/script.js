"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const get = id => document.getElementById(id);
function bytes(text) {
  const plain = atob(text), array = new Uint8Array(plain.length);
  for (let i = 0; i < array.length; i++) array[i] = plain.charCodeAt(i);
  return array;
}
const floats = text => new Float32Array(bytes(text).buffer);
const xyz = floats(data.xyz), rgb = bytes(data.rgb);
const centres = floats(data.centres), directions = floats(data.directions);
const canvas = get("view"), ctx = canvas.getContext("2d");
// Points that no image sees are a group after the T dates.
const T = data.dates, groups = data.periods.length, number = new Intl.NumberFormat("en");

// A view is a rotation (rows right, up, towards the viewer), a place and pixels per unit.
const VIEWS = {
  xy: [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
  xz: [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
  yz: [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
  home: data.home,
};
let R, at, zoom, named = "home", fitted = true, slow = 1;
const on = new Array(groups).fill(true);

const packed = (r, g, b) => (255 << 24 | b << 16 | g << 8 | r) >>> 0;
const hex = c => [1, 3, 5].map(i => parseInt(c.slice(i, i + 2), 16));
const colors = data.periods.map(p => packed(...hex(p.color)));
const start = [0];
data.periods.forEach(p => start.push(start[start.length - 1] + p.shown));

let W = 0, H = 0, ratio = 1, image, pixels, depth;
function resize() {
  ratio = Math.min(window.devicePixelRatio || 1, 2);
  const w = Math.max(1, Math.round(canvas.clientWidth * ratio));
  const h = Math.max(1, Math.round(canvas.clientHeight * ratio));
  if (w !== W || h !== H) {
    if (!fitted) zoom *= Math.min(w, h) / Math.min(W, H);
    canvas.width = W = w; canvas.height = H = h;
    image = ctx.createImageData(W, H);
    pixels = new Uint32Array(image.data.buffer);
    depth = new Float32Array(W * H);
  }
  if (fitted) look(named); else redraw();
}

function look(name) {
  R = VIEWS[name].map(row => row.slice());
  at = [0, 0, 0];
  const reach = R.map(row => row.reduce((sum, x, i) => sum + Math.abs(x) * data.half[i], 0));
  zoom = 0.92 * Math.min(W / 2 / reach[0], H / 2 / reach[1]);
  named = name; fitted = true;
  redraw();
}

let waiting = false;
function redraw() {
  if (!waiting) { waiting = true; requestAnimationFrame(draw); }
}

function draw() {
  waiting = false;
  const before = performance.now();
  const dark = document.documentElement.classList.contains("dark");
  pixels.fill(dark ? packed(21, 22, 26) : packed(255, 255, 255));
  depth.fill(-Infinity);
  for (let p = 0; p < groups; p++) if (on[p]) drawPoints(p, moving ? slow : 1);
  ctx.putImageData(image, 0, 0);
  if (get("with-cameras").checked) drawCameras(dark);
  drawScale(dark);
  const took = performance.now() - before;
  if (moving) slow = Math.min(16, Math.max(1, slow * (took > 45 ? 1.5 : took < 20 ? 0.8 : 1)));
  document.querySelectorAll("#views button").forEach(
    b => b.setAttribute("aria-pressed", b.dataset.view === named));
}

function drawPoints(p, step) {
  const photo = get("with-photo").checked;
  const dot = Math.round(get("size").value * ratio), off = dot >> 1;
  const [a, b, c] = R, [x0, y0, z0] = at, cx = W / 2, cy = H / 2, color = colors[p];
  const last = start[p] + Math.ceil((start[p + 1] - start[p]) / step);
  for (let i = start[p]; i < last; i++) {
    const x = xyz[3 * i] - x0, y = xyz[3 * i + 1] - y0, z = xyz[3 * i + 2] - z0;
    const u = Math.round(cx + zoom * (a[0] * x + a[1] * y + a[2] * z)) - off;
    const v = Math.round(cy - zoom * (b[0] * x + b[1] * y + b[2] * z)) - off;
    if (u < 0 || v < 0 || u + dot > W || v + dot > H) continue;
    const near = c[0] * x + c[1] * y + c[2] * z;
    const ink = photo ? packed(rgb[3 * i], rgb[3 * i + 1], rgb[3 * i + 2]) : color;
    for (let row = v; row < v + dot; row++) {
      for (let k = row * W + u, end = k + dot; k < end; k++) {
        if (near > depth[k]) { depth[k] = near; pixels[k] = ink; }
      }
    }
  }
}

const screen = (x, y, z) => {
  x -= at[0]; y -= at[1]; z -= at[2];
  const to = row => row[0] * x + row[1] * y + row[2] * z;
  return [W / 2 + zoom * to(R[0]), H / 2 - zoom * to(R[1])];
};

function drawCameras(dark) {
  const reach = 0.035 * Math.max(...data.half);
  ctx.lineWidth = ratio;
  for (let i = 0; i < data.camera_period.length; i++) {
    const p = data.camera_period[i];
    if (!on[p]) continue;
    const c = centres.subarray(3 * i, 3 * i + 3), d = directions.subarray(3 * i, 3 * i + 3);
    const from = screen(c[0], c[1], c[2]);
    const to = screen(c[0] + reach * d[0], c[1] + reach * d[1], c[2] + reach * d[2]);
    ctx.strokeStyle = dark ? "#dddddd" : "#222222";
    ctx.beginPath(); ctx.moveTo(...from); ctx.lineTo(...to); ctx.stroke();
    ctx.fillStyle = data.periods[p].color;
    ctx.beginPath(); ctx.arc(...from, 3 * ratio, 0, 2 * Math.PI); ctx.fill(); ctx.stroke();
  }
}

function drawScale(dark) {
  const ink = dark ? "#ececef" : "#1d1d1f", left = 18 * ratio, bottom = H - 18 * ratio;
  const want = 130 * ratio / zoom, power = 10 ** Math.floor(Math.log10(want));
  const length = [5, 2, 1].map(f => f * power).find(l => l <= want) || power;
  ctx.fillStyle = dark ? "rgba(21, 22, 26, 0.8)" : "rgba(255, 255, 255, 0.8)";
  ctx.fillRect(left - 10 * ratio, bottom - 104 * ratio,
    Math.max(length * zoom + 20 * ratio, 92 * ratio), 114 * ratio);
  ctx.strokeStyle = ctx.fillStyle = ink;
  ctx.lineWidth = 2 * ratio;
  ctx.beginPath(); ctx.moveTo(left, bottom); ctx.lineTo(left + length * zoom, bottom); ctx.stroke();
  ctx.font = `${12 * ratio}px system-ui, sans-serif`;
  const unit = data.unit || (length === 1 ? "unit" : "units");
  ctx.fillText(`${+length.toPrecision(1)} ${unit}`, left, bottom - 7 * ratio);
  const ox = left + 34 * ratio, oy = bottom - 60 * ratio, arm = 24 * ratio;
  ["x", "y", "z"].forEach((name, i) => {
    const dx = R[0][i] * arm, dy = -R[1][i] * arm;
    ctx.beginPath(); ctx.moveTo(ox, oy); ctx.lineTo(ox + dx, oy + dy); ctx.stroke();
    if (Math.hypot(dx, dy) > arm / 5) {
      ctx.fillText(name, ox + 1.3 * dx - 3 * ratio, oy + 1.3 * dy + 4 * ratio);
    }
  });
}

// Turning is about the axes of the screen: nothing has to know what is up.
function turn(dx, dy) {
  const rotate = (i, j, angle) => {
    const c = Math.cos(angle), s = Math.sin(angle), first = R[i], second = R[j];
    R[i] = first.map((x, k) => c * x + s * second[k]);
    R[j] = second.map((x, k) => c * x - s * first[k]);
  };
  rotate(0, 2, dx); rotate(2, 1, dy);
  named = ""; fitted = false; redraw();
}
function move(dx, dy) {
  for (let i = 0; i < 3; i++) at[i] += (dy * R[1][i] - dx * R[0][i]) / zoom;
  fitted = false; redraw();
}
function zoomBy(factor, x = W / 2, y = H / 2) {
  const limit = Math.min(W, H) / Math.max(...data.half);
  const next = Math.min(1e5 * limit, Math.max(1e-3 * limit, zoom * factor)), f = next / zoom;
  move((x - W / 2) * (1 - f) / f, (y - H / 2) * (1 - f) / f);  // what is under (x, y) stays there
  zoom = next;
}

const fingers = new Map();
let moving = false, rest = 0;
function busy() {
  moving = true; clearTimeout(rest);
  rest = setTimeout(() => { moving = false; redraw(); }, 160);
}
canvas.addEventListener("pointerdown", e => {
  canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, [e.clientX, e.clientY]);
});
canvas.addEventListener("pointermove", e => {
  const last = fingers.get(e.pointerId);
  if (!last) return;
  busy();
  const dx = e.clientX - last[0], dy = e.clientY - last[1], others = [...fingers.entries()];
  if (fingers.size === 2) {
    const other = others.find(([id]) => id !== e.pointerId)[1];
    const span = (x, y) => Math.hypot(x - other[0], y - other[1]) || 1;
    zoomBy(span(e.clientX, e.clientY) / span(...last));
    move(dx * ratio / 2, dy * ratio / 2);
  } else if (e.shiftKey || e.buttons & 6) move(dx * ratio, dy * ratio);
  else turn(dx * 0.008, dy * 0.008);
  fingers.set(e.pointerId, [e.clientX, e.clientY]);
});
for (const end of ["pointerup", "pointercancel"]) {
  canvas.addEventListener(end, e => fingers.delete(e.pointerId));
}
canvas.addEventListener("contextmenu", e => e.preventDefault());
canvas.addEventListener("wheel", e => {
  e.preventDefault(); busy();
  const box = canvas.getBoundingClientRect(), lines = e.deltaMode ? 20 : 1;
  zoomBy(Math.exp(-0.0015 * lines * e.deltaY),
    (e.clientX - box.left) * ratio, (e.clientY - box.top) * ratio);
}, { passive: false });

const KEYS = {
  "1": () => look("xy"), "2": () => look("xz"), "3": () => look("yz"), "0": () => look("home"),
  "+": () => zoomBy(1.2), "=": () => zoomBy(1.2), "-": () => zoomBy(1 / 1.2),
  "[": () => { stop(); only(Math.max(-1, +get("one").value - 1)); },
  "]": () => { stop(); only(Math.min(T - 1, +get("one").value + 1)); },
  p: () => get("play").click(),
  c: () => get("with-cameras").click(),
};
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
document.addEventListener("keydown", e => {
  if (e.ctrlKey || e.metaKey || e.altKey) return;
  if (e.target.type === "range" && e.key in ARROWS) return;
  if (e.key in ARROWS) {
    const [dx, dy] = ARROWS[e.key];
    if (e.shiftKey) move(40 * ratio * dx, 40 * ratio * dy); else turn(0.1 * dx, 0.1 * dy);
  } else if (e.key in KEYS) KEYS[e.key]();
  else return;
  e.preventDefault();
});

const boxes = data.periods.map((period, p) => {
  const label = document.createElement("label"), box = document.createElement("input");
  const swatch = document.createElement("i"), name = document.createElement("span");
  const count = document.createElement("small");
  box.type = "checkbox"; box.checked = true;
  swatch.style.background = period.color;
  name.textContent = p >= T ? period.label
    : period.label === String(p) ? `Period ${p}` : `${p}: ${period.label}`;
  name.title = `${name.textContent} (${number.format(period.cameras)} cameras)`;
  count.textContent = number.format(period.points);
  label.append(box, swatch, name, count);
  get("periods").append(label);
  box.addEventListener("change", () => {
    stop();
    on[p] = box.checked; get("one").value = -1; get("which").value = "some"; redraw();
    if (on.every(Boolean)) get("which").value = "all";
  });
  return box;
});
function only(p) {
  get("one").value = p;
  get("which").value = p < 0 ? "all" : String(p);
  boxes.forEach((box, i) => { box.checked = on[i] = p < 0 || i === p; });
  redraw();
}
let player = 0;
function stop() {
  clearInterval(player); player = 0;
  get("play").textContent = "play"; get("play").setAttribute("aria-pressed", "false");
}
function play() {
  if (T < 2) return;
  const next = () => only((+get("one").value + 1) % T);
  next(); player = setInterval(next, 1200);
  get("play").textContent = "stop"; get("play").setAttribute("aria-pressed", "true");
}
get("play").addEventListener("click", () => { if (player) stop(); else play(); });
get("one").max = T - 1;
get("single").hidden = T < 2;
get("one").addEventListener("input", e => { stop(); only(+e.target.value); });
for (const id of ["with-cameras", "with-photo", "size"]) get(id).addEventListener("input", redraw);
document.querySelectorAll("#views button").forEach(
  b => b.addEventListener("click", () => look(b.dataset.view)));
get("theme").addEventListener("click", () => {
  document.documentElement.classList.toggle("dark"); redraw();
});
if (matchMedia("(prefers-color-scheme: dark)").matches) {
  document.documentElement.classList.add("dark");
}
get("name").textContent = data.name;
const shown = data.periods.reduce((sum, p) => sum + p.shown, 0);
get("counts").textContent = (shown < data.points
  ? `${number.format(shown)} of ${number.format(data.points)} points, chosen at random`
  : `${number.format(shown)} points`)
  + `, ${number.format(data.camera_period.length)} cameras`
  + (data.left_out ? `; ${number.format(data.left_out)} that are not finite are left out` : "");
// Few points are easier to see as large dots, many do not clot as small ones.
get("size").value = [[150000, 1], [3000, 2], [300, 3], [30, 5]].find(([n]) => shown > n)?.[1] || 6;
canvas.setAttribute("aria-label", `Points of ${data.name}, coloured by period`);
// What a link asks for: #view=xy&period=1&cameras&photo&play&dark
const asked = new URLSearchParams(location.hash.slice(1));
if (asked.has("dark")) document.documentElement.classList.toggle("dark", asked.get("dark") !== "0");
if (asked.has("cameras")) get("with-cameras").checked = true;
if (asked.has("photo")) get("with-photo").checked = true;
new ResizeObserver(resize).observe(canvas);
resize();
if (asked.get("view") in VIEWS) look(asked.get("view"));
if (asked.has("period")) only(Math.min(T - 1, Math.max(-1, Math.round(+asked.get("period")) || 0)));
if (asked.has("play")) play();
