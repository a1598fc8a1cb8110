// The stage: the frame of a step, what the shown candidate says it sees on it, and the strip of scores.
"use strict";

const SVG = "http://www.w3.org/2000/svg";
// The model's coordinates run over 256 x 256; the camera's image is 4 : 3.
const ACROSS = (256 * 4) / 3;
const DOWN = 256;
const FLAGS = ["grasped", "ever grasped", "grasped for some steps", "moved the right object", "moved the wrong object", "on target", "success now", "success at some step", "released success"];
const FLAG_GRASPED = 0;
const FLAG_SUCCESS = 6;

function drawn(name, attributes) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

function label(text, x, y) {
  const made = drawn("text", { x: Math.min(x, ACROSS - 70), y: y < 14 ? y + 14 : y - 4 });
  made.textContent = text;
  return made;
}

// Boxes and gripper position as the candidate wrote them, over the frame it was shown.
function drawOverlay(overlay, candidate, phrases) {
  overlay.setAttribute("viewBox", `0 0 ${ACROSS} ${DOWN}`);
  overlay.replaceChildren();
  if (!candidate || candidate.malformed !== undefined) return;
  const x = (value) => (value * ACROSS) / 256;
  candidate.boxes.forEach(([name, left, top, right, bottom], index) => {
    const place = { x: x(left), y: top, width: Math.max(x(right - left), 1), height: Math.max(bottom - top, 1) };
    overlay.append(drawn("rect", { ...place, class: "shade" }));
    overlay.append(drawn("rect", { ...place, class: index === 0 ? "source" : "target" }));
    overlay.append(label(phrases[name], x(left), top));
  });
  for (const [column, row] of candidate.gripper) {
    const ring = { cx: x(column), cy: row, r: 7 };
    overlay.append(drawn("circle", { ...ring, class: "shade" }), drawn("circle", { ...ring, class: "gripper" }));
    overlay.append(label("gripper", x(column) + 9, row + 18));
  }
}

function hasFlag(step, flag) {
  return (step.flags & (1 << flag)) !== 0;
}

function hasScores(steps) {
  return steps.some((step) => step.candidates.some((candidate) => candidate.score !== null));
}

// What held at a frame: the statistics after the step that led to it; nothing held before the first.
function drawFlags(holder, steps, frame) {
  holder.replaceChildren(
    ...FLAGS.map((name, flag) => {
      const on = frame > 0 && hasFlag(steps[frame - 1], flag);
      return element("span", on ? "on" : "", name);
    }),
  );
}

// One unit wide per step; scores from 1 (top) to 0, below them what held after each step.
function drawStrip(strip, steps) {
  const height = (score) => 4 + (1 - score) * 76;
  strip.setAttribute("viewBox", `0 0 ${steps.length} 100`);
  strip.replaceChildren();
  const upper = [];
  const lower = [];
  const chosen = [];
  steps.forEach((step, index) => {
    const scores = step.candidates.map((candidate) => candidate.score).filter((score) => score !== null);
    const middle = index + 0.5;
    if (scores.length > 0) {
      upper.push(`${middle},${height(Math.max(...scores))}`);
      lower.unshift(`${middle},${height(Math.min(...scores))}`);
    }
    const executed = step.chosen === null ? null : step.candidates[step.chosen].score;
    if (executed !== null) chosen.push(`${middle},${height(executed)}`);
    if (step.candidates.some((candidate) => candidate.malformed !== undefined)) {
      strip.append(drawn("rect", { x: index, y: 0, width: 1, height: 3, class: "malformed" }));
    }
    if (hasFlag(step, FLAG_GRASPED)) {
      strip.append(drawn("rect", { x: index, y: 84, width: 1.02, height: 7, class: "grasped" }));
    }
    if (hasFlag(step, FLAG_SUCCESS)) {
      strip.append(drawn("rect", { x: index, y: 92, width: 1.02, height: 7, class: "succeeded" }));
    }
  });
  strip.append(drawn("polygon", { points: upper.concat(lower).join(" "), class: "band" }));
  strip.append(drawn("polyline", { points: chosen.join(" "), class: "chosen" }));
  strip.append(drawn("line", { x1: 0, x2: 0, y1: 0, y2: 100, class: "cursor" }));
}

function moveCursor(strip, frame, steps) {
  const cursor = strip.querySelector(".cursor");
  const place = Math.min(frame + 0.5, steps.length);
  cursor.setAttribute("x1", place);
  cursor.setAttribute("x2", place);
}
