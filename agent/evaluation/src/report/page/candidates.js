// The candidates of one step: what each says, its action and score, and which one was executed.
"use strict";

const TAGS = ["TASK", "PLAN", "VISIBLE OBJECTS", "SUBTASK REASONING", "SUBTASK", "MOVE REASONING", "MOVE", "GRIPPER POSITION"];

// Text of models reaches the page through textContent alone, so it can never become markup.
function element(name, className, text) {
  const made = document.createElement(name);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
}

function decimal(value, digits) {
  return value.toFixed(digits).replace("-", "−");
}

// The eight sections of a well-formed candidate, in the order in which it wrote them.
function sections(candidate, phrases) {
  const [task, plan, subtaskReasoning, subtask, moveReasoning, move] = candidate.says.map((index) => phrases[index]);
  const objects = candidate.boxes.map(([name, ...box]) => `${phrases[name]} [${box.join(", ")}]`).join(", ");
  const gripper = candidate.gripper.map((point) => `[${point.join(", ")}]`).join(" ");
  return [task, plan, objects, subtaskReasoning, subtask, moveReasoning, move, gripper];
}

// How far a score is below the best of its siblings: one decision changes little, so that three digits would look alike.
function standing(candidate, candidates) {
  const scores = candidates.filter((one) => one.malformed === undefined && one.score !== null).map((one) => one.score);
  if (scores.length < 2 || candidate.malformed !== undefined) return "";
  const best = Math.max(...scores);
  return candidate.score === best ? " (best)" : ` (${decimal(100 * (candidate.score - best), 3)} percentage points)`;
}

function candidateHead(candidate, index, isChosen, candidates) {
  const head = element("div", "candidate-head");
  head.append(element("span", "name", `candidate ${index + 1}`));
  if (isChosen) head.append(element("span", "tag chosen", "executed"));
  if (candidate.malformed !== undefined) head.append(element("span", "tag malformed", "malformed"));
  const bar = element("span", "bar");
  if (candidate.score !== null) {
    const fill = element("i");
    fill.style.width = `${Math.round(candidate.score * 100)}%`;
    bar.append(fill);
  } else {
    bar.style.visibility = "hidden";
  }
  const score = candidate.score === null ? "" : `score ${decimal(candidate.score, 3)}${standing(candidate, candidates)}  `;
  head.append(bar, element("span", "right", `${score}log p ${decimal(candidate.log, 1)}`));
  return head;
}

// Seven numbers are a Bridge action: metres, radians, gripper. Others are shown as they are.
function actionLine(action) {
  const line = element("div", "action");
  const part = (label, text) => {
    const item = element("span", "", `${label} `);
    item.append(element("b", "", text));
    line.append(item);
  };
  if (action.length !== 7) {
    part("action", action.map((value) => decimal(value, 3)).join("  "));
    return line;
  }
  const list = (values, scale) => values.map((value) => decimal(value * scale, 1)).join("  ");
  part("move (mm)", list(action.slice(0, 3), 1000));
  part("turn (°)", list(action.slice(3, 6), 180 / Math.PI));
  part("gripper", action[6] > 0 ? "open" : "closed");
  return line;
}

function tagList(said, reference) {
  const list = element("dl", "tags");
  said.forEach((text, place) => {
    if (text === "") return; // a policy that acts without reasoning says nothing
    const kind = reference === null ? "" : reference[place] === text ? "same" : "differs";
    list.append(element("dt", "", TAGS[place]), element("dd", kind, text));
  });
  return list;
}

// Builds the cards of a step, the executed candidate first; `shown` is the candidate whose boxes are on the frame, `show` changes it.
function candidateCards(step, phrases, shown, show) {
  const chosen = step.chosen === null ? null : step.candidates[step.chosen];
  const reference = chosen === null ? null : sections(chosen, phrases);
  const cards = step.candidates.map((candidate, index) => {
    const isChosen = index === step.chosen;
    const card = element("article", "candidate");
    card.classList.toggle("shown", index === shown);
    card.classList.toggle("chosen-card", isChosen);
    card.append(candidateHead(candidate, index, isChosen, step.candidates));
    if (candidate.malformed !== undefined) {
      card.classList.add("malformed");
      card.append(element("div", "note", phrases[candidate.malformed]));
      card.append(element("div", "raw mono", phrases[candidate.text].trim()));
    } else {
      card.append(...candidate.actions.map(actionLine));
      card.append(tagList(sections(candidate, phrases), isChosen ? null : reference));
    }
    card.addEventListener("click", () => show(index));
    return card;
  });
  return chosen === null ? cards : [cards[step.chosen], ...cards.filter((_, index) => index !== step.chosen)];
}
