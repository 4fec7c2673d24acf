// Address of a view: what follows # says camera, period and mode, so that a link shows the same.

/** Write the state as the part of an address after #. */
function addressOf(state) {
  const values = new URLSearchParams();
  values.set("period", String(+state.period.toFixed(3)));
  if (state.run) values.set("run", state.run);
  if (state.mode !== "years") {
    values.set("mode", state.mode);
    values.set("a", state.pair[0].join("."));
    values.set("b", state.pair[1].join("."));
    if (state.mode === "wipe") values.set("wipe", state.wipe.toFixed(3));
  }
  if (state.frame) values.set("camera", state.frame.name);
  else {
    const { eye, rotation, distance } = state.view;
    const numbers = [...eye, ...quaternionOf(rotation), distance];
    values.set("view", numbers.map(value => +value.toFixed(5)).join("_"));
  }
  return values.toString();
}

/** Read an address; `problems` gets a sentence for each part that this page cannot show. */
function stateFrom(address, scene, problems) {
  const values = new URLSearchParams(address), state = {}, last = scene.periods.length - 1;
  const number = (name, high, what, fits = () => true) => {
    if (!values.has(name)) return undefined;
    const value = values.get(name).trim() === "" ? NaN : Number(values.get(name));
    if (value >= 0 && value <= high && fits(value)) return value;
    problems.push(`The link asks for ${what} ${values.get(name)}, but here are 0 to ${high}.`);
    return undefined;
  };
  state.period = number("period", last, "period");
  // Addresses leave out the first run.
  state.run = values.has("run")
    ? number("run", scene.runs.length - 1, "run", Number.isInteger) : 0;
  state.wipe = number("wipe", 1, "the wipe at");
  const mode = values.get("mode");
  if (["wipe", "blink"].includes(mode)) state.mode = mode;
  const pair = ["a", "b"].map(name => (values.get(name) || "").split(".").map(Number));
  const known = ([run, period]) => scene.runs[run] && scene.periods[period];
  if (pair.every(known)) state.pair = pair;
  if (values.has("camera")) {
    state.frame = scene.frames.find(frame => frame.name === values.get("camera"));
    if (!state.frame) problems.push(`There is no photo ${values.get("camera")} here.`);
  }
  const numbers = (values.get("view") || "").split("_").map(Number);
  const [x, y, z, qw, qx, qy, qz, distance] = numbers;
  const norm = Math.hypot(qw, qx, qy, qz);
  if (numbers.length === 8 && numbers.every(Number.isFinite) && norm > 0.1 && distance > 0) {
    const rotation = rotationOf([qw, qx, qy, qz].map(value => value / norm));
    state.view = { eye: [x, y, z], rotation, distance };
  } else if (values.has("view")) problems.push("The view in the link is damaged.");
  return state;
}
