// Elements of the page: made from text alone, refilled without losing the focus, and numbers as people read them.
"use strict";

const SVG = "http://www.w3.org/2000/svg";

// Text of models reaches the page through textContent alone, so it can never become markup.
function element(name, className, text) {
  const made = document.createElement(name);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
}

function drawn(name, attributes) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

function byId(id) {
  return document.getElementById(id);
}

// A button that keeps its focus when its surroundings are rebuilt; `key` names it within them.
function button(className, text, key, action) {
  const made = element("button", className, text);
  made.type = "button";
  made.dataset.key = key;
  made.addEventListener("click", action);
  return made;
}

// Replaces what an element holds; the focus stays on the element with the same key.
function refill(holder, ...nodes) {
  const focused = document.activeElement;
  const key = holder.contains(focused) ? focused.dataset.key : undefined;
  holder.replaceChildren(...nodes);
  if (key === undefined) return;
  holder.querySelector(`[data-key="${CSS.escape(key)}"]`)?.focus({ preventScroll: true });
}

function decimal(value, digits) {
  return value.toFixed(digits).replace("-", "−");
}

function signed(value, digits) {
  const text = decimal(value, digits);
  return value > 0 ? `+${text}` : text;
}

function ordinal(place) {
  const ends = { one: "st", two: "nd", few: "rd", other: "th" };
  return `${place}${ends[new Intl.PluralRules("en", { type: "ordinal" }).select(place)]}`;
}

// The marks of outcomes, and what they mean.
const OUTCOMES = {
  success: ["✓", "success"],
  lost: ["◐", "success, then lost"],
  grasped: ["○", "grasped, no success"],
  failure: ["✗", "never grasped"],
  none: ["–", "policy never acted"],
  fault: ["⚠", "fault: no attempt ended"],
};

// A mark with its meaning for those who cannot see it.
function mark(outcome) {
  const made = element("span", `mark ${outcome}`);
  const [sign, meaning] = OUTCOMES[outcome];
  const symbol = element("span", "", sign);
  symbol.setAttribute("aria-hidden", "true");
  made.append(symbol, element("span", "unseen", meaning));
  made.title = meaning;
  return made;
}
