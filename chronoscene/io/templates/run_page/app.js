// The page: its state, what it draws, and its buttons.

const FLIGHT_TIME = 900, BLINK_TIME = 700;  // Milliseconds
const MAX_RATIO = 2;  // Pixels of the picture per pixel of the page
const byId = id => document.getElementById(id);
const still = matchMedia("(prefers-reduced-motion: reduce)").matches;

class App {
  constructor(scene) {
    this.scene = scene;
    this.up = scene.up;
    this.canvas = byId("picture");
    this.lines = byId("lines");
    this.renderer = new Renderer(this.canvas, () => this.request());
    this.sets = scene.runs.map(() => []);  // By run and period
    this.view = scene.home;
    this.frame = null;
    this.run = 0;
    this.period = 0;
    this.mode = "years";
    this.wipe = 0.5;
    const last = scene.periods.length - 1;
    this.canCompare = scene.runs.length > 1 || last > 0;
    this.pair = scene.runs.length > 1 ? [[0, 0], [1, 0]] : [[0, 0], [0, last]];
    this.blinkSecond = false;
    this.cameras = true;
    this.measuring = false;
    this.points = [];
    this.marked = null;
    this.panel = new Panel(this);
  }

  /** Take the Gaussians of a run. */
  async load(run, data) {
    const gaussians = await decodeGaussians(data), { count, geometry } = gaussians;
    const centres = new Float32Array(3 * count);
    for (let i = 0; i < count; i++) {
      centres.set(geometry.subarray(PER_GEOMETRY * i, PER_GEOMETRY * i + 3), 3 * i);
    }
    const textures = this.renderer.addGaussians(gaussians), { near, antialiased } =
      this.scene.runs[run];
    for (const text of data.members) {
      const members = await decodeMembers(text, count);
      this.sets[run].push(
        this.renderer.addSet(textures, centres, members, { near, antialiased, geometry }));
    }
  }

  // What is shown

  /** Sets of Gaussians to draw, and how to mix them. */
  mixture() {
    if (this.mode === "years") {
      const low = Math.min(Math.floor(this.period), this.scene.periods.length - 1);
      const [first, second] = [low, Math.ceil(this.period)].map(p => this.sets[this.run][p]);
      return { first, second, share: this.period - low, wipe: null };
    }
    const [first, second] = this.pair.map(([run, period]) => this.sets[run][period]);
    if (this.mode === "wipe") return { first, second, share: 0, wipe: this.wipe };
    const shown = this.blinkSecond ? second : first;
    return { first: shown, second: shown, share: 0, wipe: null };
  }

  /** Period whose cameras are shown. */
  nearestPeriod() {
    if (this.mode === "years") return Math.round(this.period);
    return this.pair[this.mode === "blink" && this.blinkSecond ? 1 : 0][1];
  }

  /** Set that a place of the canvas shows, by its share of the width. */
  setAt(share) {
    const { first, second, share: mix, wipe } = this.mixture();
    return (wipe === null ? mix > 0.5 : share >= wipe) ? second : first;
  }

  frames() {
    if (!this.cameras) return [];
    const period = this.nearestPeriod();
    return this.scene.frames.filter(frame => frame.period === period && frame !== this.frame);
  }

  // Drawing

  /** Draw soon: once for all changes until then. */
  request() {
    if (this.requested) return;
    this.requested = true;
    requestAnimationFrame(now => {
      this.requested = false;
      this.fly(now);
      this.draw();
    });
  }

  draw() {
    const { first, second } = this.mixture();
    if (!first || !second) return;
    const { clientWidth: w, clientHeight: h } = this.canvas;
    const ratio = Math.min(devicePixelRatio || 1, MAX_RATIO);
    this.renderer.resize(Math.max(1, Math.round(w * ratio)), Math.max(1, Math.round(h * ratio)));
    this.renderer.draw(this.mixture(), this.view);
    this.drawLines(w, h);
  }

  drawLines(w, h) {
    const ratio = devicePixelRatio || 1, context = this.lines.getContext("2d"), size = [w, h];
    [this.lines.width, this.lines.height] = [w * ratio, h * ratio];
    context.scale(ratio, ratio);
    const frames = this.frames();
    if (!frames.includes(this.marked)) this.marked = null;
    drawFrusta(context, this.view, size, frames, this.scene.frustum, this.marked);
    if (this.frame) drawOutline(context, this.view, size);
    if (this.mode === "wipe") drawWipe(context, size, this.wipe);
    drawMeasure(context, this.view, size, this.points, this.measured());
    if (this.marked) label(context, this.marked.name, ...this.pointer);
  }

  /** Draw once, at once and without lines, for tests: pixels as {width, height, rgba}, rgba in
   *  base64 with the lowest row first. `camera` is the name of a photo, at whose size it draws. */
  renderOnce({ run = 0, period = 0, camera, width, height }) {
    const frame = this.scene.frames.find(f => f.name === camera) || { ...this.view };
    this.renderer.resize(width || frame.camera.width, height || frame.camera.height);
    const [low, high] = [Math.floor(period), Math.ceil(period)].map(p => this.sets[run][p]);
    const mixture = { first: low, second: high, share: period % 1, wipe: null };
    this.renderer.draw(mixture, frame, true);
    let text = "";
    for (const byte of this.renderer.readPixels()) text += String.fromCharCode(byte);
    return { width: this.canvas.width, height: this.canvas.height, rgba: btoa(text) };
  }

  // Moving

  /** Change the view by a function of it; the photo beside it is left. */
  move(change) {
    this.flight = this.marked = null;
    this.view = change(this.view);
    if (this.frame) this.leave();
    this.changed();
  }

  /** Fly to a view. */
  flyTo(target) {
    if (still) this.view = target;
    else this.flight = { from: this.view, to: target, start: performance.now() };
    this.changed();
  }

  fly(now) {
    if (!this.flight) return;
    const { from, to, start } = this.flight, t = Math.min(1, (now - start) / FLIGHT_TIME);
    this.view = t < 1 ? viewBetween(from, to, t) : to;
    if (t < 1) this.request();
    else this.flight = null;
  }

  /** Fly to the camera of a photo and show the photo beside its rendering. */
  visit(frame) {
    this.frame = frame;
    this.marked = null;
    if (this.mode === "years") this.period = frame.period;
    this.panel.showPhoto(frame);
    const { eye, rotation, camera } = frame, set = this.sets[this.run][frame.period];
    const view = { eye, rotation, camera, distance: this.view.distance };
    // Later turns go around what is in the middle of the photo.
    const point = set && pick(set, view, camera.width, camera.height, camera.cx, camera.cy);
    if (point) view.distance = length(subtract(point, eye));
    this.flyTo(view);
  }

  leave() {
    this.frame = null;
    this.panel.showPhoto(null);
  }

  /** Visit the photo before or after this one, of the period that is shown. */
  step(by) {
    const period = this.nearestPeriod();
    const frames = this.scene.frames.filter(frame => frame.period === period);
    if (!frames.length) return;
    const at = frames.indexOf(this.frame);
    const next = at < 0 ? (by > 0 ? 0 : -1) : at + by;
    this.visit(frames[(next + frames.length) % frames.length]);
  }

  home() {
    this.leave();
    this.flyTo(this.scene.home);
  }

  // Mouse and touch

  hover(x, y) {
    this.pointer = [x, y];
    const { clientWidth: w, clientHeight: h } = this.canvas;
    const marked = this.measuring ? null
      : frameAt(this.view, [w, h], this.frames(), this.scene.frustum, x, y, 8);
    this.lines.style.cursor = marked ? "pointer" : this.measuring ? "crosshair"
      : this.nearWipe(x) ? "ew-resize" : "grab";
    if (marked !== this.marked) this.request();
    this.marked = marked;
  }

  /** The mouse has left the canvas. */
  unmark() {
    if (this.marked) this.request();
    this.marked = null;
  }

  /** Touch or click on a place: measure from or to there, or visit the camera that is there. */
  tap(x, y, reach) {
    const { clientWidth: w, clientHeight: h } = this.canvas;
    if (this.measuring) {
      const point = pick(this.setAt(x / w), this.view, w, h, x, y);
      if (!point) return this.panel.say("Nothing is drawn there that a distance could start from.");
      this.points = this.points.length === 2 ? [point] : [...this.points, point];
      this.panel.say(this.measured() || "Now the second point.");
      this.request();
    } else {
      const frame = frameAt(this.view, [w, h], this.frames(), this.scene.frustum, x, y, reach);
      if (frame) this.visit(frame);
    }
  }

  nearWipe(x) {
    return this.mode === "wipe" && Math.abs(x - this.wipe * this.canvas.clientWidth) < 22;
  }

  /** Distance between the two points in words; empty with less than two. */
  measured() {
    if (this.points.length < 2) return "";
    const distance = length(subtract(...this.points)) * this.scene.unitsPerLength;
    return `${distance.toFixed(distance < 10 ? 2 : 1)} ${this.scene.metric ? "m" : "units"}`;
  }

  // State

  changed() {
    this.panel.update();
    this.request();
    clearTimeout(this.saving);
    this.saving = setTimeout(() => this.saveAddress(), 250);
  }

  saveAddress() {
    const view = this.flight ? this.flight.to : this.view;
    history.replaceState(null, "", `#${addressOf({ ...this, view })}`);
  }

  /** Show what the address asks for. */
  applyAddress() {
    const problems = [], state = stateFrom(location.hash.slice(1), this.scene, problems);
    this.flight = null;
    if (state.view) this.view = { ...this.scene.home, ...state.view };
    if (state.frame) this.visit(state.frame);  // goes to its period, which may not be the one shown
    else this.leave();
    for (const name of ["period", "run", "pair", "wipe"]) {
      if (state[name] !== undefined) this[name] = state[name];
    }
    this.setMode(state.mode || "years");
    if (problems.length) this.panel.say(problems.join(" "));
  }

  setPeriod(period) {
    this.period = Math.max(0, Math.min(this.scene.periods.length - 1, period));
    this.changed();
  }

  setMode(mode) {
    this.mode = this.canCompare ? mode : "years";
    this.blinkSecond = false;
    clearInterval(this.blinking);
    if (mode === "blink") {
      this.blinking = setInterval(() => {
        this.blinkSecond = !this.blinkSecond;
        this.panel.update();
        this.request();
      }, BLINK_TIME);
    }
    this.changed();
  }

  setWipe(share) {
    this.wipe = Math.max(0, Math.min(1, share));
    this.changed();
  }

  toggleCameras() {
    this.cameras = !this.cameras;
    this.changed();
  }

  toggleMeasuring() {
    this.measuring = !this.measuring;
    this.points = [];
    if (this.measuring) this.panel.say(this.scene.metric ? "Click two points."
      : "Click two points. The scene has no metres: distances are in its own units.");
    this.changed();
  }

  /** Do what a key stands for; true if it stands for anything. */
  key(key) {
    const toPeriod = period => () => {
      if (this.mode !== "years") this.setMode("years");
      this.setPeriod(period);
    };
    const toggled = mode => () => this.setMode(this.mode === mode ? "years" : mode);
    const action = {
      b: toggled("blink"), x: toggled("wipe"),
      ",": toPeriod(Math.ceil(this.period) - 1), ".": toPeriod(Math.floor(this.period) + 1),
      "[": () => this.step(-1), "]": () => this.step(1),
      c: () => this.toggleCameras(), m: () => this.toggleMeasuring(), h: () => this.home(),
      escape: () => this.frame && this.move(view => view), "?": () => this.panel.help(),
    }[key] || (/^[1-9]$/.test(key) && key <= this.scene.periods.length && toPeriod(key - 1));
    if (action) action();
    return Boolean(action);
  }
}
