// The viewer: one pair of episodes whose images, strips and candidates move together; its state is in the link.
"use strict";

class Viewer {
  constructor(catalogue) {
    this.catalogue = catalogue;
    [this.leftSetting, this.rightSetting] = catalogue.compared;
    Object.assign(this, { pair: null, step: 0, clock: 0, isPlaying: false, active: "left", section: null, opened: 0 });
    const handlers = (side) => ({
      setting: (value) => this.chooseSetting(side, value),
      toggle: () => this.toggle(),
      scrub: (step) => (this.pause(), this.goTo(step)),
    });
    this.left = new Side(byId("left"), "left", catalogue, handlers("left"));
    this.right = new Side(byId("right"), "right", catalogue, handlers("right"));
    this.list = new PairList(catalogue, (pair) => this.open(pair));
    this.listen();
  }

  get sides() {
    return [this.left, this.right];
  }

  get activeSide() {
    return this.active === "left" ? this.left : this.right;
  }

  get stepsMax() {
    return Math.max(...this.sides.map((side) => side.steps.length), 0);
  }

  listen() {
    const on = (id, action) => byId(id).addEventListener("click", action);
    on("play", () => this.toggle());
    on("step-back", () => (this.pause(), this.goTo(this.step - 1)));
    on("step-on", () => (this.pause(), this.goTo(this.step + 1)));
    on("previous-pair", () => this.move(-1));
    on("next-pair", () => this.move(1));
    on("copy-link", (event) => copyWith(event.currentTarget, location.href));
    byId("scrubber").addEventListener("input", () => (this.pause(), this.goTo(byId("scrubber").valueAsNumber)));
    byId("speed").addEventListener("change", () => this.isPlaying && (this.pause(), this.play()));
    byId("viewer").addEventListener("keydown", (event) => this.pressed(event));
    window.addEventListener("hashchange", () => this.follow(true));
    for (const link of document.querySelectorAll("nav a, .skip")) {
      link.addEventListener("click", (event) => {
        event.preventDefault();
        this.section = link.hash.slice(1);
        goToSection(this.section);
        if (this.section === "after-viewer") byId("after-viewer").focus();
        this.link();
      });
    }
  }

  episodeOf(pair, setting) {
    return setting === null ? undefined : pair.episodes.find((entry) => entry.setting === setting);
  }

  chooseSetting(side, value) {
    const setting = value === "" ? null : Number(value);
    if (side === "left") this.leftSetting = setting;
    else this.rightSetting = setting;
    this.list.compare(this.leftSetting, this.rightSetting);
    this.open(this.pair, this.step);
  }

  // Opens a pair at a step; without one where the left's choice stands out most.
  async open(pair, step) {
    this.pause();
    this.pair = pair;
    const opened = ++this.opened;
    const entries = [this.leftSetting, this.rightSetting].map((setting) => this.episodeOf(pair, setting));
    const isAlone = this.rightSetting === null;
    byId("stages").classList.toggle("alone", isAlone);
    byId("right").hidden = isAlone;
    this.left.offer(pair, this.leftSetting, false);
    this.right.offer(pair, this.rightSetting, true);
    this.offerSecond(isAlone);
    byId("pair-title").textContent = `${this.catalogue.tasks[pair.task]} · ${pair.layout}`;
    this.showVerdict(pair);
    this.list.select(pair);
    byId("previous-pair").disabled = this.list.neighbour(-1) === undefined;
    byId("next-pair").disabled = this.list.neighbour(1) === undefined;
    if (isAlone) this.active = "left";
    const settings = [this.leftSetting, this.rightSetting].map((setting) => this.catalogue.settings[setting]);
    await Promise.all(this.sides.map((side, index) => side.open(entries[index], settings[index])));
    if (opened !== this.opened) return; // another pair was opened meanwhile
    byId("scrubber").max = this.stepsMax;
    this.goTo(step ?? entries[0]?.choice ?? 0);
  }

  // With one side alone, the way back to two is beside the play button of the left.
  offerSecond(isAlone) {
    byId("beside")?.remove();
    if (!isAlone || this.catalogue.settings.length < 2) return;
    const made = button("", "Compare", "beside", () => this.chooseSetting("right", String(this.leftSetting === 0 ? 1 : 0)));
    made.id = "beside";
    byId("controls").append(made);
  }

  showVerdict(pair) {
    const result = this.rightSetting === null ? null : this.list.result(pair);
    const names = [this.leftSetting, this.rightSetting].map((setting) => this.catalogue.settings[setting]?.name);
    const texts = { won: `only ${names[0]} succeeded`, lost: `only ${names[1]} succeeded`, both: "both succeeded", neither: "neither succeeded" };
    byId("verdict").textContent = texts[result] ?? "";
    byId("verdict").className = result === null ? "" : `badge ${result}`;
  }

  goTo(target) {
    const step = Math.max(0, Math.min(Number.isFinite(target) ? Math.trunc(target) : 0, this.stepsMax));
    this.clock = step;
    this.show(step);
    for (const side of this.sides) side.seek(step, false);
    this.link();
  }

  show(step) {
    this.step = step;
    byId("scrubber").value = step;
    byId("step-number").textContent = step === this.stepsMax && step > 0 ? `end of ${this.stepsMax}` : `step ${step} of ${this.stepsMax}`;
    for (const side of this.sides) side.show(step);
    this.drawDecision();
  }

  // Who the cards are of: both sides where both chose among several, else the one that did.
  drawWhose() {
    const holder = byId("whose");
    if (this.rightSetting === null) {
      holder.replaceChildren();
      return;
    }
    const made = this.sides.map((side, index) => {
      const setting = this.catalogue.settings[index === 0 ? this.leftSetting : this.rightSetting];
      const one = button("", setting.name, side.name, () => {
        this.active = side.name;
        this.drawDecision();
      });
      one.setAttribute("aria-pressed", String(this.active === side.name));
      return one;
    });
    refill(holder, ...made);
  }

  drawDecision() {
    this.drawWhose();
    const side = this.activeSide;
    const [cards, said, why] = ["cards", "said", "why"].map(byId);
    const step = side.steps[side.step];
    const empty = (text) => {
      byId("decision-title").textContent = text;
      cards.replaceChildren();
      said.replaceChildren();
      why.replaceChildren();
    };
    if (side.details === null) return empty(side.entry ? "No steps to show" : "No episode");
    if (step === undefined) return empty("The last image: what the last step led to");
    if (step.decision_ms === null) return empty("No decision here: a further action of the chunk decided before");
    const count = step.candidates.length;
    const held = step.chosen === null ? ": none is well formed, the robot held still" : "";
    byId("decision-title").textContent = `${count} ${count === 1 ? "candidate" : "candidates"} at step ${side.step}${held}`;
    const known = advantages(step.candidates);
    const view = {
      shown: side.shown ?? 0,
      phrases: side.details.phrases,
      noTerms: side.details.no_terms,
      advantages: known,
      reach: Math.max(...step.candidates.flatMap((one) => (one.actions ?? [[]])[0].slice(0, 3).map(Math.abs)), 0),
      span: Math.max(...known.map((value) => Math.abs(value ?? 0))),
      choose: (index) => this.choose(index),
    };
    const setting = this.catalogue.settings[this.active === "left" ? this.leftSetting : this.rightSetting];
    refill(cards, ...step.candidates.map((_, index) => card(step, index, view)));
    said.replaceChildren(saidBy(step, view));
    why.replaceChildren(...whyNodes(step, view, setting));
    byId("decision").dataset.strategy = setting.strategy;
  }

  // Shows what a candidate says and where it sees things; what was executed stays as it is.
  choose(index) {
    const side = this.activeSide;
    side.shown = index;
    side.drawBoxes();
    this.drawDecision();
  }

  toggle() {
    if (this.isPlaying) this.pause();
    else this.play();
  }

  play() {
    if (this.stepsMax === 0) return;
    if (this.step >= this.stepsMax) this.goTo(0);
    this.isPlaying = true;
    byId("play").textContent = "Pause";
    const speed = Number(byId("speed").value);
    for (const side of this.sides) side.play(speed);
    let last = performance.now();
    const tick = (now) => {
      if (!this.isPlaying) return;
      // A frame may have begun before the play button was pressed.
      this.clock += (Math.max(0, now - last) / 1000) * this.catalogue.frames_per_second * speed;
      last = now;
      if (this.clock >= this.stepsMax) return this.ended();
      const step = Math.floor(this.clock);
      if (step !== this.step) this.show(step);
      for (const side of this.sides) side.seek(this.clock, true);
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  ended() {
    if (byId("loop").checked) {
      this.goTo(0);
      this.play();
      return;
    }
    this.pause();
    this.goTo(this.stepsMax);
  }

  pause() {
    if (!this.isPlaying) return;
    this.isPlaying = false;
    byId("play").textContent = "Play";
    for (const side of this.sides) side.video.pause();
    this.goTo(this.step);
  }

  move(by) {
    const next = this.list.neighbour(by);
    if (next) this.open(next);
  }

  // Keys of the viewer; what a focused control does with a key stays its own.
  pressed(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || this.pair === null) return;
    const name = event.target.tagName;
    if (["SELECT", "INPUT", "TEXTAREA"].includes(name)) return;
    if (event.key === " " && ["BUTTON", "SUMMARY"].includes(name)) return;
    const stepBy = (by) => () => (this.pause(), this.goTo(this.step + by));
    const actions = {
      ArrowLeft: stepBy(-1),
      ArrowRight: stepBy(1),
      Home: () => (this.pause(), this.goTo(0)),
      End: () => (this.pause(), this.goTo(this.stepsMax)),
      " ": () => this.toggle(),
      n: () => this.move(1),
      p: () => this.move(-1),
    };
    const digit = Number.parseInt(event.key, 10);
    const step = this.activeSide.steps[this.activeSide.step];
    if (step && digit >= 1 && digit <= step.candidates.length) this.choose(digit - 1);
    else if (Object.hasOwn(actions, event.key)) actions[event.key]();
    else return;
    event.preventDefault();
  }

  // The link to this episode and step; while a video plays the address stays as it is.
  link() {
    if (this.isPlaying) return;
    const [ours, theirs] = [this.leftSetting, this.rightSetting].map((setting) => this.episodeOf(this.pair, setting));
    const words = new URLSearchParams();
    if (ours) words.set("episode", ours.id);
    if (theirs) words.set("with", theirs.id);
    words.set("step", String(this.step));
    if (this.section) words.set("section", this.section);
    history.replaceState(null, "", `#${words}`);
  }

  find(id) {
    for (const pair of this.catalogue.pairs) {
      const entry = pair.episodes.find((one) => one.id === id);
      if (entry) return [pair, entry];
    }
    return null;
  }

  // Opens what the address asks for: an episode and a step, or a section.
  follow(isChange) {
    const hash = location.hash.slice(1);
    const words = new URLSearchParams(hash);
    const found = this.find(words.get("episode"));
    const section = words.get("section") ?? (found === null && hash !== "" && byId(hash) !== null ? hash : null);
    if (section !== null) {
      this.section = section;
      goToSection(section);
    }
    if (found === null) {
      if (!isChange) this.open(this.catalogue.pairs[this.catalogue.opening]);
      return;
    }
    const [pair, entry] = found;
    const beside = pair.episodes.find((one) => one.id === words.get("with"));
    this.leftSetting = entry.setting;
    if (beside) this.rightSetting = beside.setting;
    else if (this.rightSetting === entry.setting) this.rightSetting = this.catalogue.settings.findIndex((_, index) => index !== entry.setting);
    if (this.rightSetting < 0) this.rightSetting = null;
    this.list.compare(this.leftSetting, this.rightSetting);
    const step = Number(words.get("step") ?? Number.NaN);
    this.open(pair, Number.isFinite(step) ? step : undefined);
    if (section === null) byId("episodes").scrollIntoView();
  }
}

(() => {
  byId("viewer").hidden = false;
  document.documentElement.classList.add("scripted");
  const viewer = new Viewer(window.reverCatalogue);
  viewer.list.compare(viewer.leftSetting, viewer.rightSetting);
  viewer.follow(false);
  addDownloads();
  addCopyButtons();
  addTips();
})();
