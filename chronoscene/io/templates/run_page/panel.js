// Buttons, slider, photo and messages: they call the app, and show its state.

class Panel {
  constructor(app) {
    this.app = app;
    const { scene } = app, slider = byId("period");
    slider.max = scene.periods.length - 1;
    slider.addEventListener("input", () => app.setPeriod(Number(slider.value)));
    // Let go near a period: that period.
    slider.addEventListener("change", () => {
      const nearest = Math.round(app.period);
      if (Math.abs(app.period - nearest) < 0.12) app.setPeriod(nearest);
    });
    this.fillTicks();
    this.fillChoices();
    byId("modes").hidden = !app.canCompare;
    slider.hidden = scene.periods.length < 2;
    const footer = document.querySelector("footer");
    new ResizeObserver(() => document.body.style.setProperty("--footer", `${footer.offsetHeight}px`))
      .observe(footer);
    for (const button of document.querySelectorAll("[data-mode]")) {
      button.addEventListener("click", () => app.setMode(button.dataset.mode));
    }
    const actions = {
      "cameras": () => app.toggleCameras(), "measure": () => app.toggleMeasuring(),
      "home": () => app.home(), "copy": () => this.copyLink(), "open-help": () => this.help(),
      "before": () => app.step(-1), "after": () => app.step(1),
      "close-photo": () => app.move(view => view), "close-help": () => byId("help").close(),
    };
    for (const [id, action] of Object.entries(actions)) byId(id).addEventListener("click", action);
  }

  fillTicks() {
    const { scene } = this.app;
    this.ticks = scene.periods.map((name, i) => {
      const tick = document.createElement("button");
      tick.textContent = name;
      tick.title = `Show ${name}` + (i < 9 ? ` (key ${i + 1})` : "");
      tick.addEventListener("click", () => this.app.setPeriod(i));
      byId("ticks").append(tick);
      return tick;
    });
  }

  /** Fill the lists of runs and of what can be compared. */
  fillChoices() {
    const { app } = this, { runs, periods } = app.scene;
    const option = (text, value) => new Option(text, value);
    runs.forEach(({ name }, i) => byId("run").append(option(name, i)));
    byId("run-choice").hidden = runs.length < 2;
    byId("run").addEventListener("change", event => {
      app.run = Number(event.target.value);
      app.changed();
    });
    ["first", "second"].forEach((id, side) => {
      runs.forEach(({ name }, run) => periods.forEach((period, i) =>
        byId(id).append(option(runs.length > 1 ? `${name}: ${period}` : period, `${run}.${i}`))));
      byId(id).addEventListener("change", event => {
        app.pair[side] = event.target.value.split(".").map(Number);
        app.changed();
      });
    });
  }

  /** Show the state of the app. */
  update() {
    const { app } = this, { scene } = app, nearest = app.nearestPeriod();
    byId("period").value = app.period;
    byId("period").setAttribute("aria-valuetext", scene.periods[Math.round(app.period)]);
    byId("run").value = app.run;
    ["first", "second"].forEach((id, side) => { byId(id).value = app.pair[side].join("."); });
    for (const button of document.querySelectorAll("[data-mode]")) {
      button.setAttribute("aria-pressed", button.dataset.mode === app.mode);
    }
    byId("cameras").setAttribute("aria-pressed", app.cameras);
    byId("measure").setAttribute("aria-pressed", app.measuring);
    byId("years").hidden = app.mode !== "years";
    byId("pair").hidden = app.mode === "years";
    this.ticks.forEach((tick, i) => tick.setAttribute("aria-current", i === nearest));
    const shown = app.mode === "blink" ? [app.blinkSecond ? 1 : 0] : [0, 1];
    ["first", "second"].forEach((id, side) =>
      byId(id).classList.toggle("shown", shown.includes(side)));
  }

  /** Show the photo of a frame beside the picture; null for none. */
  showPhoto(frame) {
    byId("photo-side").hidden = !frame;
    document.body.classList.toggle("beside", Boolean(frame));
    if (frame) {
      const photo = byId("photo"), known = Boolean(frame.photo);
      photo.hidden = !known;
      byId("no-photo").hidden = known;
      if (known) photo.src = frame.photo;
      photo.alt = `Photo ${frame.name}`;
      byId("photo-name").textContent = `${frame.name} · ${this.app.scene.periods[frame.period]} · `
        + (frame.split === "test" ? "test view, not trained on" : "training view");
    }
    this.app.request();
  }

  /** Show a message for a while. */
  say(text) {
    const place = byId("message");
    place.textContent = text;
    place.hidden = false;
    clearTimeout(this.saying);
    this.saying = setTimeout(() => { place.hidden = true; }, 6000);
  }

  async copyLink() {
    this.app.saveAddress();
    try {
      await navigator.clipboard.writeText(location.href);
      this.say("The link to this view is copied.");
    } catch {
      this.say("The link to this view is in the address bar.");
    }
  }

  help() {
    byId("help").showModal();
  }
}
