// One side of the comparison: the setting's episode on this layout, its video, overlay and strip.
"use strict";

// Episodes whose steps were loaded, the latest last.
const loaded = new Map();
const LOADED_MAX = 12;
const waiting = new Map();
// A video may be this far from the clock before it is moved, in seconds.
const DRIFT_MAX = 0.15;
const NO_VIDEO = "No video was stored for this episode. Render it from the record: rever report RUN --video";

// A page opened from disk may not fetch, but it may add a script that hands over its data.
function loadSteps(id) {
  if (loaded.has(id)) return Promise.resolve(loaded.get(id));
  if (!waiting.has(id)) {
    const promise = new Promise((resolve, reject) => {
      const script = element("script");
      script.src = `data/${encodeURIComponent(id)}.js`;
      script.addEventListener("load", () => script.remove());
      script.addEventListener("error", () => reject(new Error(`the file ${script.getAttribute("src")} does not load`)));
      waiting.set(id, { resolve, promise: null });
      document.head.append(script);
    });
    waiting.get(id).promise = promise.finally(() => waiting.delete(id));
  }
  return waiting.get(id).promise;
}

window.reverEpisode = (data) => {
  loaded.set(data.id, data);
  if (loaded.size > LOADED_MAX) loaded.delete(loaded.keys().next().value);
  waiting.get(data.id)?.resolve(data);
};

class Side {
  constructor(root, name, catalogue, handlers) {
    Object.assign(this, { root, name, catalogue, handlers, entry: null, details: null, shown: null, step: 0 });
    this.select = element("select");
    this.select.setAttribute("aria-label", `Setting on the ${name}`);
    this.select.addEventListener("change", () => handlers.setting(this.select.value));
    this.outcome = element("span", "outcome");
    this.video = element("video");
    Object.assign(this.video, { muted: true, playsInline: true, preload: "auto", tabIndex: -1 });
    this.overlay = drawn("svg", { class: "overlay", viewBox: "0 0 4 3", preserveAspectRatio: "none", "aria-hidden": "true" });
    this.notice = element("p", "no-video");
    this.stage = element("div", "stage");
    this.stage.tabIndex = 0;
    this.stage.setAttribute("role", "group");
    this.stage.append(this.video, this.overlay, this.notice);
    this.stage.addEventListener("click", handlers.toggle);
    this.strip = drawn("svg", { class: "strip", preserveAspectRatio: "none", "aria-hidden": "true" });
    this.key = element("div", "strip-key");
    this.strips = element("div", "strips");
    this.strips.append(this.key, this.strip);
    this.state = element("p", "state");
    const head = element("div", "side-head");
    head.append(this.select, this.outcome);
    root.append(head, this.stage, this.strips, this.state);
    for (const kind of ["pointerdown", "pointermove"]) this.strip.addEventListener(kind, (event) => this.scrub(event));
  }

  scrub(event) {
    if (this.details === null || (event.type === "pointermove" && event.buttons === 0)) return;
    const bounds = this.strip.getBoundingClientRect();
    this.handlers.scrub(Math.floor(((event.clientX - bounds.left) / bounds.width) * this.steps.length));
  }

  get steps() {
    return this.details === null ? [] : this.details.steps;
  }

  // Fills the choice of settings: each with its outcome on this layout.
  offer(pair, chosen, isOptional) {
    const options = this.catalogue.settings.map((setting, index) => {
      const entry = pair.episodes.find((one) => one.setting === index);
      const sign = entry ? OUTCOMES[entry.outcome][0] : "·";
      return new Option(`${sign} ${setting.name}${entry ? "" : " (not run here)"}`, String(index));
    });
    if (isOptional) options.push(new Option("nothing beside it", ""));
    this.select.replaceChildren(...options);
    this.select.value = chosen === null ? "" : String(chosen);
  }

  // Shows an episode, or that there is none; resolves when its steps are there.
  async open(entry, setting) {
    this.entry = entry;
    this.details = null;
    this.shown = null;
    this.root.dataset.strategy = setting ? setting.strategy : "";
    this.outcome.replaceChildren(...(entry ? [mark(entry.outcome), ` ${describeOutcome(entry)}`] : []));
    this.overlay.replaceChildren();
    this.strip.replaceChildren();
    this.key.replaceChildren();
    this.state.textContent = "";
    const hasVideo = Boolean(entry && entry.video);
    this.video.hidden = !hasVideo;
    if (hasVideo) this.video.src = `videos/${encodeURIComponent(entry.id)}.mp4`;
    else this.video.removeAttribute("src");
    this.notice.textContent = this.missing(entry);
    this.stage.setAttribute("aria-label", setting ? `${setting.name}, camera image. Space plays, arrow keys step` : "no episode");
    if (!entry || !entry.detail) return;
    try {
      const details = await loadSteps(entry.id);
      if (this.entry !== entry) return;
      this.details = details;
    } catch (error) {
      this.notice.textContent = error.message;
      return;
    }
    const span = drawStrip(this.strip, this.steps);
    refill(this.key, ...stripKey(this.steps, span));
  }

  missing(entry) {
    if (!entry) return "No episode of this setting on this layout.";
    if (entry.outcome === "fault") return `No attempt ended: ${entry.reason}`;
    if (!entry.detail) return "The steps of this episode are not in the report. Build it with a larger --episodes-max to see them.";
    return entry.video ? "" : NO_VIDEO;
  }

  // Shows a step; one beyond the end is the last image.
  show(step) {
    if (this.details === null) return;
    this.step = Math.min(step, this.steps.length);
    this.shown = this.chosen();
    moveCursor(this.strip, this.step, this.steps);
    this.drawBoxes();
    const held = flagsAt(this.steps, this.step);
    const end = this.step === this.steps.length ? "Last image. " : "";
    this.state.textContent = `${end}${held.length > 0 ? held.join(", ") : "nothing reached yet"}`;
  }

  chosen() {
    return this.step < this.steps.length ? this.steps[this.step].chosen : null;
  }

  drawBoxes() {
    const step = this.steps[this.step];
    drawOverlay(this.overlay, step && this.shown !== null ? step.candidates[this.shown] : null, this.details.phrases);
  }

  // Moves the video to a place on the clock, in steps; while it plays only if it has drifted away.
  seek(clock, isPlaying) {
    if (!this.entry || !this.entry.video) return;
    const last = this.steps.length > 0 ? this.steps.length : this.entry.steps;
    // The middle of a frame's time, so that rounding never shows its neighbour.
    const wanted = Math.min(isPlaying ? clock : Math.floor(clock) + 0.5, last + 0.5) / this.catalogue.frames_per_second;
    if (!isPlaying || Math.abs(this.video.currentTime - wanted) > DRIFT_MAX) this.video.currentTime = wanted;
  }

  play(speed) {
    if (!this.entry || !this.entry.video) return;
    this.video.playbackRate = speed;
    this.video.play().catch(() => {}); // a video that ends or goes at once is no error
  }
}

// What an episode came to, and when it first grasped and first succeeded.
function describeOutcome(entry) {
  const at = (step) => (step === undefined ? "" : ` (step ${step})`);
  const isSuccess = entry.success !== undefined;
  const parts = [`${OUTCOMES[entry.outcome][1]}${at(isSuccess ? entry.success : entry.grasp)}`];
  if (isSuccess && entry.grasp !== undefined) parts.push(`grasp${at(entry.grasp)}`);
  if (entry.faults) parts.push(`${entry.faults} ${entry.faults === 1 ? "fault" : "faults"}`);
  return parts.join(" · ");
}
