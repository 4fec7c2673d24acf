const $ = id => document.getElementById(id), view = $("view"), lens = $("lens");
const photos = DATA.photos, KEY = `chronoscene-marks-${DATA.key}`, LENS = 5, NEAR = 4;
let state = DATA.state, history = [], photo = 0, point = 0;
let scale = 1, shift = [0, 0], cursor = null, images = new Map();
// state.points: {name, role, world, sigma, marks: {photo name: [x, y]}}, pixels of the original.
if (!state.points.length) addPoint();
const initial = JSON.stringify(state);
let saved = initial;

const kept = (() => { try { return localStorage.getItem(KEY); } catch { return null; } })();
if (kept && kept !== initial) {
  state = JSON.parse(kept);
  say("The marks of last time are back; Undo goes back to the file.");
  history.push(initial);
}
addEventListener("beforeunload", e => { if (JSON.stringify(state) !== saved) e.preventDefault(); });

function say(text) { $("status").textContent = text; }
function counted(n, word) { return `${n} ${word}${n === 1 ? "" : "s"}`; }
function change(action) {
  history.push(JSON.stringify(state));
  action();
  keep();
}
function keep() {
  const text = JSON.stringify(state);
  try {
    if (text === initial) localStorage.removeItem(KEY); else localStorage.setItem(KEY, text);
  } catch { /* private mode: the warning remains */ }
  const marks = state.points.reduce((n, p) => n + Object.keys(p.marks).length, 0);
  say(`${counted(state.points.length, "point")}, ${counted(marks, "mark")}${text === saved ? "" : ", not saved"}`);
  show();
}
function undo() {
  if (!history.length) return;
  state = JSON.parse(history.pop());
  point = Math.min(point, state.points.length - 1);
  keep();
}
function addPoint() {
  let n = state.points.length + 1;
  while (state.points.some(p => p.name === `point${n}`)) n++;
  state.points.push({ name: `point${n}`, role: "tie", world: "", sigma: "", marks: {} });
  point = state.points.length - 1;
}
const mark = () => state.points[point].marks[photos[photo].name];
function cameraOf(name) { return photos.find(p => p.name === name)?.camera; }

// Where the chosen point should be in a photo: {at} by two marks or more, {line} by one.
function predict(target) {
  if (!target.camera) return null;
  const seen = Object.entries(state.points[point].marks)
    .filter(([name]) => name !== target.name && cameraOf(name))
    .map(([name, xy]) => ray(cameraOf(name), xy));
  const inside = xy => xy && xy[0] > -target.width && xy[0] < 2 * target.width
    && xy[1] > -target.height && xy[1] < 2 * target.height ? xy : null;
  if (seen.length > 1) {
    const place = intersect(seen), at = place && inside(project(target.camera, place));
    return at ? { at } : null;
  }
  if (!seen.length) return null;
  const [{ centre, direction }] = seen, [near, far] = DATA.depths, line = [];
  for (let i = 0; i <= 60; i++) {
    const depth = near * (far / near) ** (i / 60);
    line.push(inside(project(target.camera, centre.map((c, k) => c + depth * direction[k]))));
  }
  return line.some(Boolean) ? { line } : null;
}
const posed = photos.some(p => p.camera);  // Without a model, only marked photos are near.
const isNear = p => {
  const found = predict(p), within = xy => xy && xy[0] >= 0 && xy[0] <= p.width && xy[1] >= 0
    && xy[1] <= p.height;
  return state.points[point].marks[p.name] || within(found?.at) || found?.line?.some(within);
};
function step(by) {
  const from = photo;
  do photo = (photo + by + photos.length) % photos.length;
  while (photo !== from && $("only").checked && !isNear(photos[photo]));
  if (photo === from) say(`No other photo ${posed ? "is near" : "has a mark of"} this point.`);
  fit();
  show();
}
function choose(i) {
  point = (i + state.points.length) % state.points.length;
  keep();
}

const actions = {
  previousPhoto: () => step(-1), nextPhoto: () => step(1), undo,
  previousPoint: () => choose(point - 1), nextPoint: () => choose(point + 1),
  removeClick: () => { if (mark()) change(() => delete state.points[point].marks[photos[photo].name]); },
  addPoint: () => { change(addPoint); $("name").select(); },
  removePoint: () => change(() => {
    state.points.splice(point, 1);
    if (!state.points.length) addPoint();
    point = Math.max(0, Math.min(point, state.points.length - 1));
  }),
  zoomIn: () => zoom(1.5), zoomOut: () => zoom(1 / 1.5), fit: () => { fit(); draw(); }, save,
};
const keys = { ArrowLeft: "previousPhoto", ArrowRight: "nextPhoto", ArrowUp: "previousPoint",
  ArrowDown: "nextPoint", Delete: "removeClick", Backspace: "removeClick", a: "addPoint", u: "undo",
  "+": "zoomIn", "=": "zoomIn", "-": "zoomOut", 0: "fit", s: "save" };
addEventListener("keydown", e => {
  if (/^(INPUT|SELECT)$/.test(e.target.tagName) && e.target.type !== "checkbox") return;
  const key = e.key.length === 1 ? e.key.toLowerCase() : e.key, control = e.ctrlKey || e.metaKey;
  if (control && key !== "z" && key !== "s") return;
  const name = control ? { z: "undo", s: "save" }[key] : keys[key];
  if (!name) return;
  e.preventDefault();
  const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[key];
  if (e.shiftKey && by && mark()) change(() => mark().forEach((v, i) => mark()[i] = v + by[i] / 4));
  else actions[name]();
});
for (const button of document.querySelectorAll("[data-do]"))
  button.onclick = () => actions[button.dataset.do]();
$("save").onclick = save;
for (const field of ["name", "role", "world", "sigma"]) $(field).onchange = e => {
  const value = e.target.value.trim().replace(/[",\n]+/g, " ").replace(/\s+/g, " ");
  const numbers = value ? value.split(" ").map(Number) : [], three = numbers.length === 3;
  const taken = state.points.some((p, i) => i !== point && p.name === value);
  if (field === "name" && (!value || taken)) say("Each point needs a name of its own.");
  else if (field === "world" && numbers.length && !(three && numbers.every(isFinite)))
    say("Give three numbers: east, north, height.");
  else if (field === "sigma" && numbers.length && !(three && numbers.every(v => v > 0)))
    say("Give three numbers above 0: metres east, north, up.");
  else if (field === "role" && value === "tie" && state.points[point].world)
    say("A point with coordinates is control or check: clear them for a tie point.");
  else return change(() => {
    const chosen = state.points[point];
    chosen[field] = value;
    if (field === "world") chosen.role = !value ? "tie" : chosen.role === "tie" ? "control" : chosen.role;
  });
  e.target.value = state.points[point][field];
};
$("edit").onsubmit = e => e.preventDefault();

// A CSV that `chronoscene register --tie-points` reads; points without marks stay in it.
function save() {
  const cell = text => /[",#]|^\s|\s$/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  const lines = DATA.crs ? [`# crs: ${DATA.crs}`] : [];
  lines.push("point,image,x,y,X,Y,Z,role,sX,sY,sZ");
  for (const p of state.points) {
    const end = [...(p.world || "  ").split(" "), p.world ? p.role : "", ...(p.sigma || "  ").split(" ")];
    const rows = Object.entries(p.marks).map(([name, xy]) => [name, ...xy.map(v => v.toFixed(2))]);
    if (!rows.length && p.world) rows.push(["", "", ""]);
    for (const row of rows) lines.push([p.name, ...row, ...end].map(cell).join(","));
  }
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([lines.join("\n") + "\n"], { type: "text/csv" }));
  link.download = DATA.file;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  saved = JSON.stringify(state);
  keep();
  say(`Saved as ${DATA.file} in your downloads.`);
}

// Pixels of the original to those of the canvas (CSS) and back.
const toScreen = ([x, y]) => [x * scale + shift[0], y * scale + shift[1]];
const toPhoto = ([x, y]) => [(x - shift[0]) / scale, (y - shift[1]) / scale];
function fit() {
  const { width, height } = photos[photo];
  scale = Math.min(view.clientWidth / width, view.clientHeight / height);
  shift = [(view.clientWidth - width * scale) / 2, (view.clientHeight - height * scale) / 2];
}
function zoom(by, at = [view.clientWidth / 2, view.clientHeight / 2]) {
  const fixed = toPhoto(at);
  scale = Math.min(Math.max(scale * by, 0.02), 40);
  shift = at.map((v, i) => v - fixed[i] * scale);
  draw();
}
function picture() {
  const { name, src } = photos[photo];
  if (!images.has(name)) {
    if (images.size > 8) images.delete(images.keys().next().value);
    const image = new Image();
    image.onload = draw;
    image.src = src;
    images.set(name, image);
  }
  return images.get(name);
}
function cross(pen, [x, y], color, size = 9) {
  for (const [width, style] of [[3, "#000"], [1.5, color]]) {
    pen.lineWidth = width; pen.strokeStyle = style; pen.setLineDash([]);
    pen.beginPath();
    pen.moveTo(x - size, y); pen.lineTo(x - 2, y); pen.moveTo(x + 2, y); pen.lineTo(x + size, y);
    pen.moveTo(x, y - size); pen.lineTo(x, y - 2); pen.moveTo(x, y + 2); pen.lineTo(x, y + size);
    pen.stroke();
  }
}
function draw() {
  const ratio = devicePixelRatio || 1, pen = view.getContext("2d"), now = photos[photo];
  view.width = view.clientWidth * ratio; view.height = view.clientHeight * ratio;
  pen.scale(ratio, ratio);
  const image = picture(), [x, y] = toScreen([0, 0]);
  pen.imageSmoothingEnabled = scale * now.width / now.shown < 3;
  if (image.complete) pen.drawImage(image, x, y, now.width * scale, now.height * scale);
  const found = predict(now);
  pen.strokeStyle = "#ff0"; pen.lineWidth = 1.5; pen.setLineDash([6, 4]);
  pen.beginPath();
  if (found?.at) pen.arc(...toScreen(found.at), 16, 0, 7);
  found?.line?.forEach((at, i) => at && pen[i && found.line[i - 1] ? "lineTo" : "moveTo"](...toScreen(at)));
  pen.stroke();
  pen.font = "13px system-ui"; pen.textBaseline = "bottom";
  state.points.forEach((p, i) => {
    if (!p.marks[now.name]) return;
    const at = toScreen(p.marks[now.name]);
    cross(pen, at, i === point ? "#0f0" : "#fff");
    pen.lineWidth = 3; pen.strokeStyle = "#000"; pen.fillStyle = i === point ? "#0f0" : "#fff";
    pen.strokeText(p.name, at[0] + 8, at[1] - 4); pen.fillText(p.name, at[0] + 8, at[1] - 4);
  });
  magnify(image, now);
}
function magnify(image, now) {
  lens.hidden = !cursor;
  if (!cursor || !image.complete) return;
  lens.className = cursor[0] > view.clientWidth / 2 && cursor[1] < view.clientHeight / 2 ? "left" : "";
  const pen = lens.getContext("2d"), small = now.shown / now.width;
  const size = lens.width / Math.max(LENS, 2 * scale / small), [x, y] = toPhoto(cursor);
  pen.fillStyle = "#111"; pen.fillRect(0, 0, lens.width, lens.height);
  pen.imageSmoothingEnabled = false;
  pen.drawImage(image, x * small - size / 2, y * small - size / 2, size, size, 0, 0, lens.width, lens.height);
  cross(pen, [lens.width / 2, lens.height / 2], "#ff0", 24);
}
function show() {
  const now = photos[photo], chosen = state.points[point];
  $("photo-name").textContent = `${now.name} (${photo + 1} of ${photos.length})`;
  $("points").replaceChildren(...state.points.map((p, i) => {
    const item = document.createElement("li"), button = document.createElement("button");
    const photosOfPoint = counted(Object.keys(p.marks).length, "photo");
    button.textContent = `${p.marks[now.name] ? "✓ " : ""}${p.name} · ${p.role} · ${photosOfPoint}`;
    if (i === point) button.setAttribute("aria-current", "true");
    button.onclick = () => choose(i);
    item.append(button);
    return item;
  }));
  document.querySelector("[aria-current]")?.scrollIntoView({ block: "nearest" });
  for (const field of ["name", "role", "world", "sigma"]) $(field).value = chosen[field];
  $("role").disabled = !chosen.world;
  draw();
}

const pointers = new Map();
let pressed = null;
const place = e => [e.offsetX, e.offsetY];
view.onpointerdown = e => {
  view.setPointerCapture(e.pointerId);
  pointers.set(e.pointerId, place(e));
  pressed = pointers.size === 1 ? { at: place(e), shift: shift.slice(), moved: false } : null;
};
view.onpointermove = e => {
  cursor = place(e);
  if (pointers.size === 2 && pointers.has(e.pointerId)) {
    const other = [...pointers].find(([id]) => id !== e.pointerId)[1], old = pointers.get(e.pointerId);
    const apart = p => Math.hypot(p[0] - other[0], p[1] - other[1]);
    pointers.set(e.pointerId, cursor);
    return zoom(apart(cursor) / Math.max(apart(old), 1), other);
  }
  if (pressed) {
    const by = cursor.map((v, i) => v - pressed.at[i]);
    pressed.moved ||= Math.hypot(...by) > NEAR;
    if (pressed.moved) shift = pressed.shift.map((v, i) => v + by[i]);
  }
  draw();
};
view.onpointerup = view.onpointercancel = e => {
  pointers.delete(e.pointerId);
  const [x, y] = toPhoto(place(e)), { name, width, height } = photos[photo];
  if (e.type === "pointerup" && pressed && !pressed.moved && x >= 0 && y >= 0 && x <= width && y <= height)
    change(() => state.points[point].marks[name] = [x, y].map(v => Math.round(v * 100) / 100));
  pressed = null;
};
view.onpointerleave = () => { cursor = null; draw(); };
view.addEventListener("wheel", e => { e.preventDefault(); zoom(1.0015 ** -e.deltaY, place(e)); },
  { passive: false });
$("only").onchange = () => show();
new ResizeObserver(() => { fit(); draw(); }).observe(view);
if (!$("status").textContent) keep(); else show();
