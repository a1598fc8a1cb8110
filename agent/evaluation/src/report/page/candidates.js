// The candidates of one step: a card for each, what the shown one says, and why it was chosen or not.
"use strict";

const TAGS = ["TASK", "PLAN", "VISIBLE OBJECTS", "SUBTASK REASONING", "SUBTASK", "MOVE REASONING", "MOVE", "GRIPPER POSITION"];
const MOVE = 5; // the place of MOVE in what a candidate says

// The eight parts of a well-formed candidate, in the order in which it wrote them.
function parts(candidate, phrases) {
  const [task, plan, subtaskReasoning, subtask, moveReasoning, move] = candidate.says.map((index) => phrases[index]);
  const objects = candidate.boxes.map(([name, ...box]) => `${phrases[name]} [${box.join(", ")}]`).join(", ");
  const gripper = candidate.gripper.map((point) => `[${point.join(", ")}]`).join(" ");
  return [task, plan, objects, subtaskReasoning, subtask, moveReasoning, move, gripper];
}

// The motion of a Bridge action seen from above and its height, as a line and a bar; `reach` fills the circle.
function motionGlyph(action, reach) {
  const made = drawn("svg", { viewBox: "-22 -22 52 44", class: "glyph", "aria-hidden": "true" });
  const limited = (value) => (reach > 0 ? (18 * value) / reach : 0);
  // The base frame's x points away from the robot, y to its left.
  const [x, y, z] = [-limited(action[1]), -limited(action[0]), -limited(action[2])];
  made.append(drawn("circle", { cx: 0, cy: 0, r: 20, class: "reach" }));
  made.append(drawn("line", { x1: 0, y1: 0, x2: x, y2: y, class: "motion" }), drawn("circle", { cx: x, cy: y, r: 3, class: "motion-end" }));
  made.append(drawn("line", { x1: 27, x2: 27, y1: -20, y2: 20, class: "reach" }), drawn("line", { x1: 27, x2: 27, y1: 0, y2: z, class: "motion" }));
  return made;
}

function advantageBar(value, span) {
  const bar = element("span", "advantage-bar");
  const fill = element("i", value < 0 ? "minus" : "plus");
  fill.style.width = `${span > 0 ? (50 * Math.abs(value)) / span : 0}%`;
  bar.append(fill);
  return bar;
}

// One candidate as a button: executed or not, its advantage, what it does.
function card(step, index, view) {
  const candidate = step.candidates[index];
  const made = button("card", undefined, `card-${index}`, () => view.choose(index));
  made.setAttribute("aria-pressed", String(index === view.shown));
  made.classList.toggle("executed", index === step.chosen);
  const head = element("span", "card-head");
  head.append(element("b", "", `Candidate ${index + 1}`));
  if (index === step.chosen) head.append(element("span", "tag", "executed"));
  made.append(head);
  if (candidate.malformed !== undefined) {
    made.classList.add("malformed");
    made.append(element("span", "move", "malformed: never executed"));
    return made;
  }
  const advantage = view.advantages[index];
  if (advantage !== null) {
    const line = element("span", "card-score");
    line.append(element("strong", "", `${signed(advantage, 2)} pp`), advantageBar(advantage, view.span));
    made.append(line);
  }
  const does = element("span", "card-move");
  const action = candidate.actions[0];
  if (action.length === 7) does.append(motionGlyph(action, view.reach));
  const move = view.phrases[candidate.says[MOVE]];
  const words = element("span", "move", move === "" ? "no reasoning" : move);
  does.append(words);
  if (candidate.unread !== undefined) does.append(element("span", "tag", "partly read"));
  made.append(does);
  return made;
}

// Seven numbers are a Bridge action: metres, radians, gripper. Others are shown as they are.
function actionLine(action) {
  const line = element("div", "action");
  const part = (name, text) => {
    const item = element("span", "", `${name} `);
    item.append(element("b", "", text));
    line.append(item);
  };
  if (action.length !== 7) {
    part("action", action.map((value) => decimal(value, 3)).join("  "));
    return line;
  }
  const list = (values, scale) => values.map((value) => decimal(value * scale, 1)).join("  ");
  part("move x y z (mm)", list(action.slice(0, 3), 1000));
  part("turn (°)", list(action.slice(3, 6), 180 / Math.PI));
  part("gripper", action[6] > 0 ? "open" : "closed");
  return line;
}

// What the shown candidate wrote; where it differs from the executed one, in bold with the executed one's words.
function saidBy(step, view) {
  const candidate = step.candidates[view.shown];
  const holder = element("article", "said");
  const title = element("h4", "", `What candidate ${view.shown + 1} says`);
  holder.append(title);
  if (candidate.malformed !== undefined) {
    holder.append(element("p", "reason", view.phrases[candidate.malformed]), element("pre", "", view.phrases[candidate.text].trim()));
    return holder;
  }
  const isExecuted = view.shown === step.chosen;
  const reference = step.chosen === null || isExecuted ? null : parts(step.candidates[step.chosen], view.phrases);
  const list = element("dl", "parts");
  parts(candidate, view.phrases).forEach((text, place) => {
    if (text === "") return; // a policy that acts without reasoning says nothing
    const differs = reference !== null && reference[place] !== text;
    const said = element("dd", differs ? "differs" : "", text);
    if (differs) said.append(element("span", "executed-says", ` executed: ${reference[place]}`));
    list.append(element("dt", "", TAGS[place]), said);
  });
  holder.append(list, ...candidate.actions.map(actionLine));
  if (candidate.unread !== undefined) {
    const reasons = candidate.unread.map((index) => view.phrases[index]).join("; ");
    holder.append(element("p", "note", `Its reasoning was partly read: ${reasons}.`));
  }
  return holder;
}

// The distance of the first action from the mean of the well-formed ones, in millimetres; null where it is no motion.
function millimetresApart(step, index) {
  const actions = step.candidates.filter((one) => one.malformed === undefined).map((one) => one.actions[0]);
  if (actions.length < 2 || actions[0].length !== 7) return null;
  const mean = [0, 1, 2].map((axis) => actions.reduce((sum, action) => sum + action[axis], 0) / actions.length);
  return 1000 * Math.hypot(...mean.map((value, axis) => step.candidates[index].actions[0][axis] - value));
}

function termTable(candidate, advantage, names) {
  const [listed, others] = candidate.terms;
  const rows = listed.map(([term, value]) => [names[term], value]);
  rows.push([`${names.length - listed.length} smaller terms`, others]);
  const span = Math.max(...rows.map(([, value]) => Math.abs(value)));
  const table = element("table", "terms");
  const caption = element("caption", "", "Largest terms of its advantage (pp)");
  const body = element("tbody");
  for (const [name, value] of rows) {
    const row = element("tr");
    const head = element("th", "", name);
    head.scope = "row";
    const bar = element("td", "bar-cell");
    bar.append(advantageBar(value, span));
    row.append(head, bar, element("td", "number", signed(value, 2)));
    body.append(row);
  }
  const sum = element("tr", "sum");
  const head = element("th", "", "advantage");
  head.scope = "row";
  sum.append(head, element("td"), element("td", "number", signed(advantage, 2)));
  body.append(sum);
  table.append(caption, body);
  return table;
}

// What there is to say without terms: how the candidate differs from its siblings by the record alone.
function recordedDifferences(step, view) {
  const list = element("dl", "facts");
  const fact = (name, text) => {
    const line = element("div");
    line.append(element("dt", "", name), element("dd", "", text));
    list.append(line);
  };
  const well = step.candidates.filter((one) => one.malformed === undefined);
  const candidate = step.candidates[view.shown];
  const mean = well.reduce((sum, one) => sum + one.log, 0) / well.length;
  fact("log-probability of its tokens", `${decimal(candidate.log, 1)} (siblings’ mean ${decimal(mean, 1)})`);
  const apart = millimetresApart(step, view.shown);
  if (apart !== null) fact("its move from the mean move", `${decimal(apart, 1)} mm`);
  return list;
}

// Where the candidate stands by its score.
function standing(step, view) {
  const candidate = step.candidates[view.shown];
  const advantage = view.advantages[view.shown];
  if (candidate.score === null) return "This run recorded no score for it.";
  const text = `Score ${decimal(candidate.score, 3)}`;
  if (advantage === null) return `${text}.`;
  const known = view.advantages.filter((value) => value !== null);
  const place = known.filter((value) => value > advantage).length + 1;
  const others = view.advantages.filter((value, index) => value !== null && index !== view.shown);
  const best = Math.max(...others);
  return `${text}, ${ordinal(place)} of ${known.length}. Advantage ${signed(advantage, 2)} pp over the siblings’ mean; the best of the others has ${signed(best, 2)} pp.`;
}

// Why the shown candidate was executed, or why it was not.
function whyNodes(step, view, setting) {
  const isExecuted = view.shown === step.chosen;
  const candidate = step.candidates[view.shown];
  const number = view.shown + 1;
  const nodes = [element("h3", "", isExecuted ? `Why candidate ${number} was executed` : `Why candidate ${number} was not executed`)];
  nodes.push(element("p", "choice", `${setting.name}: ${setting.choice}`));
  if (candidate.malformed !== undefined) {
    nodes.push(element("p", "", "It is malformed, and a malformed candidate is never executed."));
    return nodes;
  }
  nodes.push(element("p", "standing", standing(step, view)));
  if (candidate.terms !== undefined) {
    nodes.push(termTable(candidate, view.advantages[view.shown], window.reverCatalogue.terms));
    if (!/verifier|worst/.test(setting.strategy)) nodes.push(element("p", "note", "These scores did not decide here: the strategy chooses otherwise."));
    return nodes;
  }
  if (step.candidates.length > 1) nodes.push(recordedDifferences(step, view));
  if (view.noTerms) nodes.push(element("p", "note", view.noTerms));
  return nodes;
}
