// Mouse, touch and keyboard. `app` has the view and what the keys do.

const ORBIT = 0.006, WHEEL = 0.0012, STEP = 0.06;  // Radians per pixel; per wheel unit; per picture
const TAP = 7;  // Pixels that a finger may slip in a tap

/** Let pointers turn, move and zoom the view. */
function listenToPointers(element, app) {
  const pointers = new Map();
  let travelled = 0, wiping = false;
  const place = event => {
    const box = element.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  element.addEventListener("pointerdown", event => {
    element.focus({ preventScroll: true });
    if (pointers.size === 0) {
      travelled = 0;
      wiping = app.nearWipe(place(event)[0]);
    }
    pointers.set(event.pointerId, place(event));
    try { element.setPointerCapture(event.pointerId); } catch { /* made by a script */ }
  });
  element.addEventListener("pointermove", event => {
    const before = pointers.get(event.pointerId), now = place(event);
    if (!before) return app.hover(...now);
    const others = [...pointers].filter(([id]) => id !== event.pointerId);
    travelled += Math.hypot(now[0] - before[0], now[1] - before[1]);
    pointers.set(event.pointerId, now);
    if (travelled < TAP && others.length === 0) return;
    if (wiping) app.setWipe(now[0] / element.clientWidth);
    else if (others.length) pinch(app, element, before, now, others[0][1]);
    else drag(app, element, before, now, event.shiftKey || event.buttons === 2);
  });
  const end = event => {
    if (pointers.delete(event.pointerId) && event.type === "pointerup" && pointers.size === 0
      && travelled < TAP) app.tap(...place(event), event.pointerType === "touch" ? 22 : 12);
  };
  element.addEventListener("pointerup", end);
  element.addEventListener("pointerleave", () => app.unmark());
  element.addEventListener("pointercancel", end);
  element.addEventListener("contextmenu", event => event.preventDefault());
  element.addEventListener("wheel", event => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 30 : 1;
    app.move(view => zoomed(view, Math.exp(WHEEL * lines * event.deltaY)));
  }, { passive: false });
}

/** One finger or the left button turns; with Shift or the right button it moves. */
function drag(app, element, before, now, moves) {
  const [dx, dy] = subtract([...now, 0], [...before, 0]);
  if (moves) app.move(view => shifted(view, element, dx, dy));
  else app.move(view => orbited(view, app.up, -ORBIT * dx, -ORBIT * dy));
}

/** Two fingers move and zoom. */
function pinch(app, element, before, now, other) {
  const reach = p => Math.max(20, Math.hypot(p[0] - other[0], p[1] - other[1]));
  app.move(view => zoomed(view, reach(before) / reach(now)));
  app.move(view => shifted(view, element, (now[0] - before[0]) / 2, (now[1] - before[1]) / 2));
}

/** Move so that what is at the pivot follows the pointer. */
function shifted(view, element, dx, dy) {
  const K = pixelsOf(view.camera, element.clientWidth, element.clientHeight);
  return moved(view, -dx / K.fx, -dy / K.fy, 0);
}

const FLIGHT = {
  w: v => moved(v, 0, 0, STEP), s: v => moved(v, 0, 0, -STEP),
  a: v => moved(v, -STEP, 0, 0), d: v => moved(v, STEP, 0, 0),
  e: v => moved(v, 0, -STEP, 0), q: v => moved(v, 0, STEP, 0),
  "+": v => zoomed(v, 0.94), "-": v => zoomed(v, 1 / 0.94),
  arrowleft: (v, up) => orbited(v, up, -STEP, 0), arrowright: (v, up) => orbited(v, up, STEP, 0),
  arrowup: (v, up) => orbited(v, up, 0, -STEP), arrowdown: (v, up) => orbited(v, up, 0, STEP),
  "shift+arrowleft": (v, up) => looked(v, up, STEP, 0),
  "shift+arrowright": (v, up) => looked(v, up, -STEP, 0),
  "shift+arrowup": (v, up) => looked(v, up, 0, STEP),
  "shift+arrowdown": (v, up) => looked(v, up, 0, -STEP),
};

/** Let keys fly while they are held, and call `app.keys` once for each of the others. */
function listenToKeys(app) {
  const held = new Map();  // By the place of the key: its sign is another one once Shift is let go
  const fly = () => {
    for (const key of held.values()) app.move(view => FLIGHT[key](view, app.up));
    if (held.size) requestAnimationFrame(fly);
  };
  document.addEventListener("keydown", event => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target.closest("select, dialog")) return;
    const plain = event.key.toLowerCase(), shifted = `shift+${plain}`;
    if (event.target.closest("input") && plain.startsWith("arrow")) return;  // moves the slider
    const key = event.shiftKey && FLIGHT[shifted] ? shifted : plain;
    if (FLIGHT[key]) {
      event.preventDefault();
      if (!held.size) requestAnimationFrame(fly);
      held.set(event.code, key);
    } else if (!event.repeat && app.key(plain)) event.preventDefault();
  });
  document.addEventListener("keyup", event => held.delete(event.code));
  addEventListener("blur", () => held.clear());
}
