// The episode browser: filters, the list, and one episode whose frame, scores and candidates move together.
"use strict";

(() => {
  const catalogue = window.reverCatalogue;
  const ROWS_AT_ONCE = 200;
  const MARKS = { success: "✓", lost: "◐", grasped: "○", failure: "✗", none: "–" };
  const byId = (id) => document.getElementById(id);
  const [list, video, overlay, strip, scrubber] = ["rows", "video", "overlay", "strip", "scrubber"].map(byId);

  let visible = []; // the catalogue entries that pass the filters
  let rowsShown = ROWS_AT_ONCE;
  let current = null; // the catalogue entry being watched
  let details = null; // its steps, once loaded
  let frame = 0; // 0 .. steps; the last frame is what the last step led to
  let shown = null; // the candidate whose boxes are drawn; null follows the executed one
  let wanted = 0; // the frame to open the next loaded episode at

  function name(entry) {
    const temperature = entry.strategy === "greedy" ? "" : ` · T ${entry.temperature}`;
    return `${entry.strategy}${entry.candidates > 1 ? ` ${entry.candidates}` : ""}${temperature}`;
  }

  function fill(select, values) {
    select.replaceChildren(new Option("all", ""), ...values.map((value) => new Option(value, value)));
  }

  function filterList() {
    const [task, strategy, outcome] = ["filter-task", "filter-strategy", "filter-outcome"].map((id) => byId(id).value);
    visible = catalogue.episodes.filter(
      (entry) => (!task || entry.task === task) && (!strategy || name(entry) === strategy) && (!outcome || entry.outcome === outcome),
    );
    rowsShown = ROWS_AT_ONCE;
    drawList();
  }

  function drawList() {
    const total = catalogue.episodes.length;
    byId("count").textContent = `${visible.length} of ${total} episodes`;
    list.replaceChildren(...visible.slice(0, rowsShown).map(row));
    byId("more").hidden = visible.length <= rowsShown;
    const marked = list.querySelector(".current");
    if (marked === null) return;
    const place = marked.offsetTop - list.offsetTop - list.scrollTop;
    const isOut = place < 0 || place + marked.clientHeight > list.clientHeight;
    if (isOut) list.scrollTop += place - list.clientHeight / 2;
  }

  function row(entry) {
    const made = element("li", entry === current ? "current" : "");
    const text = element("div", "", entry.task);
    text.append(element("br"), element("span", "where", name(entry)));
    const right = element("div", "right", entry.layout);
    right.append(element("br"), `${entry.steps} steps`);
    made.append(element("span", `mark ${entry.outcome}`, MARKS[entry.outcome]), text, right);
    made.addEventListener("click", () => open(entry, 0));
    return made;
  }

  function drawSiblings() {
    const siblings = catalogue.episodes.filter((entry) => entry.pair === current.pair);
    byId("siblings").replaceChildren(
      ...siblings.map((entry) => {
        const button = element("button", entry === current ? "current" : "", `${MARKS[entry.outcome]} ${name(entry)}`);
        button.type = "button";
        button.title = "the same layout with this strategy";
        button.addEventListener("click", () => open(entry, frame));
        return button;
      }),
    );
  }

  function open(entry, atFrame) {
    current = entry;
    details = null;
    wanted = atFrame;
    video.pause();
    drawList();
    byId("episode-title").textContent = `${entry.task} · ${entry.layout} · ${name(entry)}`;
    drawSiblings();
    byId("no-video").hidden = entry.video;
    video.hidden = !entry.video;
    if (entry.video) video.src = `videos/${encodeURIComponent(entry.id)}.mp4`;
    else video.removeAttribute("src");
    overlay.replaceChildren();
    if (!entry.detail) {
      strip.replaceChildren();
      byId("flags").replaceChildren();
      const text = "the steps of this episode were left out of the report; rebuild it with a larger --episodes-max";
      byId("candidates-column").replaceChildren(element("p", "summary", text));
      return;
    }
    // A page opened from disk may not fetch, but it may add a script that hands over its data.
    const script = element("script");
    script.src = `data/${encodeURIComponent(entry.id)}.js`;
    script.addEventListener("load", () => script.remove());
    script.addEventListener("error", () => {
      byId("candidates-column").replaceChildren(element("p", "summary", `the file ${script.src} does not load`));
    });
    document.head.append(script);
  }

  window.reverEpisode = (data) => {
    if (current === null || data.id !== current.id) return; // a late answer for an episode left already
    details = data;
    scrubber.max = data.steps.length;
    drawStrip(strip, data.steps);
    byId("strip-key").classList.toggle("unscored", !hasScores(data.steps));
    goTo(wanted);
  };

  function goTo(target) {
    if (details === null) return;
    show(target);
    // The middle of a frame's time, so that rounding never shows its neighbour.
    if (current.video) video.currentTime = (frame + 0.5) / catalogue.frames_per_second;
  }

  function show(target) {
    const { steps, phrases } = details;
    frame = Math.max(0, Math.min(target, steps.length));
    scrubber.value = frame;
    byId("step-number").textContent = frame === steps.length ? `end of ${steps.length}` : `step ${frame} of ${steps.length}`;
    moveCursor(strip, frame, steps);
    drawFlags(byId("flags"), steps, frame);
    shown = null;
    drawStep(steps, phrases);
    history.replaceState(null, "", `#episode=${encodeURIComponent(current.id)}&step=${frame}`);
  }

  function drawStep(steps, phrases) {
    const column = byId("candidates-column");
    if (frame === steps.length) {
      overlay.replaceChildren();
      column.replaceChildren(element("p", "summary", "The last frame: what the last step led to."));
      return;
    }
    const step = steps[frame];
    if (step.decision_ms === null) {
      overlay.replaceChildren();
      column.replaceChildren(element("p", "summary", "No decision here: a further action of the chunk decided before."));
      return;
    }
    const drawnIndex = shown ?? step.chosen;
    drawOverlay(overlay, drawnIndex === null ? null : step.candidates[drawnIndex], phrases);
    const plural = step.candidates.length === 1 ? "candidate" : "candidates";
    const held = step.chosen === null ? " · none is well formed: the robot held still" : "";
    const text = `${step.candidates.length} ${plural} · decided in ${decimal(step.decision_ms, 1)} ms (its share of its batch)${held}`;
    const choose = (index) => {
      shown = index;
      drawStep(steps, phrases);
    };
    column.replaceChildren(element("p", "summary", text), ...candidateCards(step, phrases, drawnIndex, choose));
  }

  function followVideo() {
    if (details !== null && !video.paused) {
      const playing = Math.floor(video.currentTime * catalogue.frames_per_second + 0.001);
      if (playing !== frame && playing <= details.steps.length) show(playing);
    }
    if (!video.paused && !video.ended) requestAnimationFrame(followVideo);
  }

  function togglePlay() {
    if (current === null || !current.video) return;
    if (!video.paused) {
      video.pause();
      return;
    }
    if (details !== null && frame === details.steps.length) goTo(0);
    video.play();
  }

  function move(by) {
    const next = visible[visible.indexOf(current) + by];
    if (next) open(next, 0);
  }

  function pressed(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT" || current === null) return;
    const step = details === null ? null : details.steps[frame];
    const actions = {
      ArrowLeft: () => (video.pause(), goTo(frame - 1)),
      ArrowRight: () => (video.pause(), goTo(frame + 1)),
      " ": togglePlay,
      n: () => move(1),
      p: () => move(-1),
    };
    const digit = Number.parseInt(event.key, 10);
    if (step && digit >= 1 && digit <= step.candidates.length) {
      shown = digit - 1;
      drawStep(details.steps, details.phrases);
    } else if (Object.hasOwn(actions, event.key)) {
      actions[event.key]();
    } else {
      return;
    }
    event.preventDefault();
  }

  function scrub(event) {
    if (details === null || (event.type === "pointermove" && event.buttons === 0)) return;
    const bounds = strip.getBoundingClientRect();
    video.pause();
    goTo(Math.floor(((event.clientX - bounds.left) / bounds.width) * details.steps.length));
  }

  function start() {
    fill(byId("filter-task"), [...new Set(catalogue.episodes.map((entry) => entry.task))]);
    fill(byId("filter-strategy"), [...new Set(catalogue.episodes.map(name))]);
    for (const id of ["filter-task", "filter-strategy", "filter-outcome"]) byId(id).addEventListener("change", filterList);
    byId("more").addEventListener("click", () => {
      rowsShown += ROWS_AT_ONCE;
      drawList();
    });
    byId("previous").addEventListener("click", () => (video.pause(), goTo(frame - 1)));
    byId("next").addEventListener("click", () => (video.pause(), goTo(frame + 1)));
    byId("play").addEventListener("click", togglePlay);
    scrubber.addEventListener("input", () => (video.pause(), goTo(scrubber.valueAsNumber)));
    strip.addEventListener("pointerdown", scrub);
    strip.addEventListener("pointermove", scrub);
    video.addEventListener("play", () => ((byId("play").textContent = "❚❚"), followVideo()));
    video.addEventListener("pause", () => (byId("play").textContent = "▶"));
    video.addEventListener("ended", () => details !== null && show(details.steps.length));
    document.addEventListener("keydown", pressed);
    filterList();
    const linked = new URLSearchParams(location.hash.slice(1));
    const entry = catalogue.episodes.find((one) => one.id === linked.get("episode")) ?? visible[0];
    if (entry) open(entry, Number(linked.get("step") ?? 0));
  }

  start();
})();
