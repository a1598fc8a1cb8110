// The strip below a stage: scores and advantages over the steps, and what held after each of them.
"use strict";

// The slope of the logit where success and failure are equally likely.
const LOGITS_PER_PROBABILITY = 4;
const LANES = { score: [4, 40], advantage: [48, 88], grasped: [94, 100], success: [107, 113] };
const STRIP_HEIGHT = 116;

function logit(score) {
  const inside = Math.min(Math.max(score, 1e-8), 1 - 1e-8);
  return Math.log(inside / (1 - inside));
}

// The advantage of each candidate over the mean of the well-formed ones, in percentage points; null for one without a score.
function advantages(candidates) {
  const isScored = (one) => one.malformed === undefined && one.score !== null;
  const logits = candidates.map((one) => (isScored(one) ? logit(one.score) : null));
  const known = logits.filter((value) => value !== null);
  if (known.length < 2) return candidates.map(() => null);
  const mean = known.reduce((sum, value) => sum + value, 0) / known.length;
  return logits.map((value) => (value === null ? null : (100 * (value - mean)) / LOGITS_PER_PROBABILITY));
}

function hasScores(steps) {
  return steps.some((step) => step.candidates.some((candidate) => candidate.score !== null));
}

// The largest advantage of an episode, for the scale of its lane.
function advantageSpan(steps) {
  let span = 0;
  for (const step of steps) {
    for (const value of advantages(step.candidates)) span = Math.max(span, Math.abs(value ?? 0));
  }
  return span;
}

function drawScores(strip, steps) {
  const [top, bottom] = LANES.score;
  const height = (score) => bottom - score * (bottom - top);
  const chosen = [];
  steps.forEach((step, index) => {
    const executed = step.chosen === null ? null : step.candidates[step.chosen].score;
    if (executed !== null) chosen.push(`${index + 0.5},${height(executed)}`);
  });
  strip.append(drawn("line", { x1: 0, x2: steps.length, y1: bottom, y2: bottom, class: "base" }));
  strip.append(drawn("polyline", { points: chosen.join(" "), class: "chosen" }));
}

// The range of the siblings, and the executed candidate in it.
function drawAdvantages(strip, steps, span) {
  const [top, bottom] = LANES.advantage;
  const middle = (top + bottom) / 2;
  const height = (value) => middle - (value / span) * ((bottom - top) / 2);
  const chosen = [];
  steps.forEach((step, index) => {
    const all = advantages(step.candidates);
    const known = all.filter((value) => value !== null);
    if (known.length > 0) {
      const [high, low] = [Math.max(...known), Math.min(...known)];
      strip.append(drawn("rect", { x: index + 0.15, width: 0.7, y: height(high), height: Math.max(height(low) - height(high), 0.5), class: "range" }));
    }
    const executed = step.chosen === null ? null : all[step.chosen];
    if (executed !== null) chosen.push(`${index + 0.5},${height(executed)}`);
  });
  strip.append(drawn("line", { x1: 0, x2: steps.length, y1: middle, y2: middle, class: "base" }));
  strip.append(drawn("polyline", { points: chosen.join(" "), class: "chosen" }));
}

// One unit wide per step.
function drawStrip(strip, steps) {
  strip.setAttribute("viewBox", `0 0 ${Math.max(steps.length, 1)} ${STRIP_HEIGHT}`);
  strip.replaceChildren();
  const span = advantageSpan(steps);
  if (hasScores(steps)) drawScores(strip, steps);
  if (span > 0) drawAdvantages(strip, steps, span);
  const bar = (lane, index) => {
    const [top, bottom] = LANES[lane];
    strip.append(drawn("rect", { x: index, y: top, width: 1.02, height: bottom - top, class: lane }));
  };
  steps.forEach((step, index) => {
    if (hasFlag(step, FLAG_GRASPED)) bar("grasped", index);
    if (hasFlag(step, FLAG_SUCCESS)) bar("success", index);
    if (step.candidates.some((one) => one.malformed !== undefined)) {
      strip.append(drawn("rect", { x: index + 0.15, y: 0, width: 0.7, height: 3, class: "malformed" }));
    }
  });
  strip.append(drawn("line", { x1: 0, x2: 0, y1: 0, y2: STRIP_HEIGHT, class: "cursor" }));
  return span;
}

// The names of the lanes, with the scale of each.
function stripKey(steps, span) {
  const names = [];
  if (hasScores(steps)) names.push(["score", "score", "0 to 1"]);
  if (span > 0) names.push(["advantage", "advantage", `±${decimal(span, span < 1 ? 2 : 1)} pp`]);
  names.push(["grasped", "grasped", ""], ["success", "success", ""]);
  return names.map(([lane, name, scale]) => {
    const made = element("span", `lane ${lane}`, name);
    if (scale) made.append(" ", element("small", "", scale));
    return made;
  });
}

function moveCursor(strip, step, steps) {
  const cursor = strip.querySelector(".cursor");
  const place = Math.min(step + 0.5, steps.length);
  cursor.setAttribute("x1", place);
  cursor.setAttribute("x2", place);
}
