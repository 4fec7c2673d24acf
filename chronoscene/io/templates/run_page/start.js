// Start: the scene is in the page, the Gaussians in a script per run, as a page that is opened from a
// file may load scripts and pictures, but nothing else.

const arrived = new Map();

/** Called by the scripts in data/. */
viewer.receive = (name, data) => arrived.set(name, data);

/** Load the script of a run. */
function loadRun(name) {
  return new Promise((resolve, reject) => {
    const script = document.createElement("script");
    script.src = `data/${name}.js`;
    script.onload = () => resolve(arrived.get(name));
    script.onerror = () => reject(new Error(`data/${name}.js is missing beside this page.`));
    document.head.append(script);
  });
}

async function start() {
  const scene = JSON.parse(byId("scene").textContent);
  const app = new App(scene);
  for (const [run, { file }] of scene.runs.entries()) {
    await app.load(run, await loadRun(file));
    arrived.delete(file);
  }
  byId("loading").hidden = true;
  app.applyAddress();
  listenToPointers(app.lines, app);
  listenToKeys(app);
  addEventListener("hashchange", () => app.applyAddress());
  new ResizeObserver(() => app.request()).observe(app.canvas);
  app.canvas.addEventListener("webglcontextlost", () =>
    fail(new Error("The graphics device was lost; load the page again.")));
  app.changed();
  return app;
}

/** Show what went wrong in place of the picture. */
function fail(error) {
  byId("loading").hidden = false;
  byId("loading").textContent = error.message;
}

viewer.ready = start().then(app => { viewer.app = app; });
viewer.ready.catch(fail);
