// The list of pairs: search, filters, order, and rows that the arrow keys move through.
"use strict";

const ROWS_AT_ONCE = 200;
const RESULTS = {
  won: "won: only the left succeeded",
  lost: "lost: only the right succeeded",
  both: "both succeeded",
  neither: "both failed",
};
const LEFT_OUTCOMES = ["success", "lost", "grasped", "failure", "none"];

class PairList {
  constructor(catalogue, open) {
    Object.assign(this, { catalogue, open, visible: [], rowsShown: ROWS_AT_ONCE, current: null, left: 0, right: null });
    catalogue.pairs.forEach((pair, index) => (pair.index = index));
    this.rows = byId("rows");
    const tasks = catalogue.tasks.map((task, index) => new Option(task, String(index)));
    byId("filter-task").replaceChildren(new Option("all", ""), ...tasks);
    for (const id of ["filter-task", "filter-result", "sort"]) byId(id).addEventListener("change", () => this.filter());
    byId("search").addEventListener("input", () => this.filter());
    byId("more").addEventListener("click", () => {
      this.rowsShown += ROWS_AT_ONCE;
      this.draw();
    });
    this.rows.addEventListener("keydown", (event) => this.pressed(event));
    byId("marks").replaceChildren(
      ...Object.keys(OUTCOMES).map((outcome) => {
        const made = element("li");
        const sign = element("span", `mark ${outcome}`, OUTCOMES[outcome][0]);
        sign.setAttribute("aria-hidden", "true");
        made.append(sign, ` ${OUTCOMES[outcome][1]}`);
        return made;
      }),
    );
  }

  // What is compared: the filters by result speak of it.
  compare(left, right) {
    this.left = left;
    this.right = right;
    const select = byId("filter-result");
    const before = select.value;
    const group = (label, entries) => {
      const made = element("optgroup");
      made.label = label;
      made.append(...entries.map(([value, text]) => new Option(text, value)));
      return made;
    };
    const names = LEFT_OUTCOMES.map((outcome) => [`outcome-${outcome}`, OUTCOMES[outcome][1]]);
    const groups = [group(`outcome of ${this.catalogue.settings[left].name}`, names), group("attempts", [["faults", "with faults"]])];
    if (right !== null) groups.unshift(group("pair", Object.entries(RESULTS)));
    select.replaceChildren(new Option("all", ""), ...groups);
    select.value = [...select.options].some((option) => option.value === before) ? before : "";
    this.filter();
  }

  sides(pair) {
    const of = (setting) => (setting === null ? undefined : pair.episodes.find((entry) => entry.setting === setting));
    return [of(this.left), of(this.right)];
  }

  // won, lost, both or neither; null where one of the two has no outcome.
  result(pair) {
    const [ours, theirs] = this.sides(pair);
    if (!ours || !theirs || [ours, theirs].some((one) => one.outcome === "fault" || one.outcome === "none")) return null;
    const [isOurs, isTheirs] = [ours, theirs].map((one) => one.outcome === "success");
    if (isOurs) return isTheirs ? "both" : "won";
    return isTheirs ? "lost" : "neither";
  }

  passes(pair) {
    const task = byId("filter-task").value;
    if (task !== "" && pair.task !== Number(task)) return false;
    const [ours, theirs] = this.sides(pair);
    if (!ours && !theirs) return false;
    const words = byId("search").value.trim().toLowerCase();
    if (words !== "") {
      const text = `${this.catalogue.tasks[pair.task]} ${pair.layout} ${[ours, theirs].map((one) => (one ? one.id : "")).join(" ")}`.toLowerCase();
      if (!words.split(/\s+/).every((word) => text.includes(word))) return false;
    }
    const result = byId("filter-result").value;
    if (result === "") return true;
    if (result === "faults") return pair.episodes.some((entry) => entry.faults);
    if (result.startsWith("outcome-")) return ours !== undefined && `outcome-${ours.outcome}` === result;
    return this.result(pair) === result;
  }

  // Smaller comes first; pairs without a value come last.
  sortKey(pair) {
    const [ours, theirs] = this.sides(pair);
    const score = (entry) => entry?.score ?? null;
    const keys = {
      success: () => ours?.success ?? null,
      high: () => (score(ours) === null ? null : -score(ours)),
      low: () => score(ours),
      gap: () => (score(ours) === null || score(theirs) === null ? null : -Math.abs(score(ours) - score(theirs))),
      faults: () => -pair.episodes.reduce((sum, entry) => sum + (entry.faults ?? 0), 0),
    };
    return keys[byId("sort").value]() ?? Infinity;
  }

  filter() {
    this.visible = this.catalogue.pairs.filter((pair) => this.passes(pair));
    if (byId("sort").value !== "order") {
      const keys = new Map(this.visible.map((pair) => [pair, this.sortKey(pair)]));
      this.visible.sort((a, b) => (keys.get(a) === keys.get(b) ? 0 : keys.get(a) - keys.get(b)));
    }
    this.rowsShown = ROWS_AT_ONCE;
    this.draw();
  }

  draw() {
    const what = this.right === null ? "episodes" : "pairs";
    byId("count").textContent = `${this.visible.length} of ${this.catalogue.pairs.length} ${what}`;
    const shown = this.visible.slice(0, this.rowsShown);
    refill(this.rows, ...shown.map((pair) => this.row(pair)));
    if (!this.rows.querySelector("[tabindex='0']")) this.rows.querySelector("button")?.setAttribute("tabindex", "0");
    byId("more").hidden = this.visible.length <= this.rowsShown;
    this.scrollToCurrent();
  }

  row(pair) {
    const line = element("li");
    const isCurrent = pair === this.current;
    const made = button("row", undefined, String(pair.index), () => this.open(pair));
    made.tabIndex = isCurrent ? 0 : -1;
    if (isCurrent) made.setAttribute("aria-current", "true");
    const [ours, theirs] = this.sides(pair);
    const marks = element("span", "marks");
    for (const entry of this.right === null ? [ours] : [ours, theirs]) marks.append(entry ? mark(entry.outcome) : element("span", "mark", "·"));
    const success = ours?.success !== undefined ? `success at ${ours.success}` : (ours?.grasp !== undefined ? `grasp at ${ours.grasp}` : "");
    const name = element("span", "what", this.catalogue.tasks[pair.task]);
    name.append(element("span", "where", ` ${pair.layout}`));
    const result = this.result(pair);
    const detail = element("span", "detail", success);
    made.append(marks, name, detail);
    if (result === "won" || result === "lost") made.append(element("span", `badge ${result}`, result));
    line.append(made);
    return line;
  }

  // Marks the row of the opened pair, without drawing all rows again.
  select(pair) {
    this.current = pair;
    const key = String(pair.index);
    for (const row of this.rows.querySelectorAll(".row")) {
      const isCurrent = row.dataset.key === key;
      row.tabIndex = isCurrent ? 0 : -1;
      if (isCurrent) row.setAttribute("aria-current", "true");
      else row.removeAttribute("aria-current");
    }
    if (!this.rows.querySelector("[tabindex='0']")) this.rows.querySelector("button")?.setAttribute("tabindex", "0");
    this.scrollToCurrent();
  }

  scrollToCurrent() {
    const row = this.rows.querySelector("[aria-current]");
    if (row === null) return;
    const top = row.offsetTop - this.rows.offsetTop;
    const isOut = top < this.rows.scrollTop || top + row.offsetHeight > this.rows.scrollTop + this.rows.clientHeight;
    if (isOut) this.rows.scrollTop = top - this.rows.clientHeight / 2;
  }

  // The pair before or after the opened one, among those that pass the filters.
  neighbour(by) {
    return this.visible[this.visible.indexOf(this.current) + by];
  }

  pressed(event) {
    const rows = [...this.rows.querySelectorAll(".row")];
    const place = rows.indexOf(document.activeElement);
    const targets = { ArrowDown: place + 1, ArrowUp: place - 1, Home: 0, End: rows.length - 1 };
    if (place < 0 || !Object.hasOwn(targets, event.key)) return;
    event.preventDefault();
    event.stopPropagation();
    const target = rows[Math.max(0, Math.min(rows.length - 1, targets[event.key]))];
    rows[place].tabIndex = -1;
    target.tabIndex = 0;
    target.focus();
  }
}
