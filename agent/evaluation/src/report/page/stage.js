// The stage: the image of a step, and what the shown candidate says it sees on it.
"use strict";

// The model's coordinates run over 256 x 256; the camera's image is 4 : 3.
const ACROSS = (256 * 4) / 3;
const DOWN = 256;
const LABEL_HEIGHT = 14;
const LETTER_WIDTH = 6.6;

// Moves a label down, then up, until it hides no other.
function freePlace(text, x, y, taken) {
  const width = text.length * LETTER_WIDTH + 6;
  const left = Math.max(2, Math.min(x, ACROSS - width));
  const isFree = (top) =>
    top > LABEL_HEIGHT && top < DOWN - 2 && taken.every((other) => other.right < left || left + width < other.left || Math.abs(other.top - top) >= LABEL_HEIGHT);
  for (let shift = 0; shift < DOWN; shift += 4) {
    const top = [y + shift, y - shift].find(isFree);
    if (top === undefined) continue;
    taken.push({ left, right: left + width, top });
    return [left, top];
  }
  return [left, y];
}

function label(text, x, y, taken) {
  const [left, top] = freePlace(text, x, y, taken);
  const made = drawn("text", { x: left, y: top });
  made.textContent = text;
  return made;
}

// Boxes and gripper position as the candidate wrote them, over the image that it was shown.
function drawOverlay(overlay, candidate, phrases) {
  overlay.setAttribute("viewBox", `0 0 ${ACROSS} ${DOWN}`);
  overlay.replaceChildren();
  if (!candidate || candidate.malformed !== undefined) return;
  const x = (value) => (value * ACROSS) / 256;
  const labels = [];
  const taken = [];
  candidate.boxes.forEach(([name, left, top, right, bottom], index) => {
    const place = { x: x(left), y: top, width: Math.max(x(right - left), 1), height: Math.max(bottom - top, 1), rx: 2 };
    overlay.append(drawn("rect", { ...place, class: "shade" }));
    overlay.append(drawn("rect", { ...place, class: index === 0 ? "source" : "target" }));
    labels.push(label(phrases[name], x(left) + 1, top - 5, taken));
  });
  for (const [column, row] of candidate.gripper) {
    const ring = { cx: x(column), cy: row, r: 7 };
    overlay.append(drawn("circle", { ...ring, class: "shade" }), drawn("circle", { ...ring, class: "gripper" }));
    labels.push(label("gripper", x(column) + 10, row + 4, taken));
  }
  overlay.append(...labels);
}

const FLAGS = ["grasped", "ever grasped", "grasped for some steps", "moved the right object", "moved the wrong object", "on target", "success now", "success at some step", "released success"];
const FLAG_GRASPED = 0;
const FLAG_SUCCESS = 6;

function hasFlag(step, flag) {
  return (step.flags & (1 << flag)) !== 0;
}

// What held at a step: the statistics after the step before it; nothing held before the first.
function flagsAt(steps, step) {
  if (step === 0) return [];
  return FLAGS.filter((_, flag) => hasFlag(steps[step - 1], flag));
}
