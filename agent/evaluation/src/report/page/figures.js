// What figures and tables can be asked for: files to download, text to copy, definitions of terms, links between sections.
"use strict";

// Properties of the style sheet that a figure on its own needs.
const FIGURE_STYLES = ["fill", "stroke", "stroke-width", "stroke-dasharray", "opacity", "font-family", "font-size", "font-weight", "paint-order"];

function download(name, type, text) {
  const link = element("a");
  link.href = URL.createObjectURL(new Blob([text], { type }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

// The figure as a file of its own: the page's styles become attributes.
function standalone(svg) {
  const copy = svg.cloneNode(true);
  const originals = [svg, ...svg.querySelectorAll("*")];
  [copy, ...copy.querySelectorAll("*")].forEach((node, index) => {
    const style = getComputedStyle(originals[index]);
    for (const property of FIGURE_STYLES) node.setAttribute(property, style.getPropertyValue(property));
    node.removeAttribute("class");
  });
  copy.setAttribute("xmlns", SVG);
  const paper = drawn("rect", { width: "100%", height: "100%", fill: getComputedStyle(document.body).backgroundColor });
  copy.prepend(paper);
  return new XMLSerializer().serializeToString(copy);
}

function addDownloads() {
  const run = window.reverCatalogue.run;
  for (const figure of document.querySelectorAll("figure[data-csv]")) {
    const name = `${run}-${figure.dataset.name}`;
    const line = element("div", "downloads");
    const offer = (kind, action) => {
      const made = button("", kind, kind, action);
      made.setAttribute("aria-label", `Download ${figure.dataset.name} as ${kind}`);
      line.append(made);
    };
    offer("CSV", () => download(`${name}.csv`, "text/csv", figure.dataset.csv));
    const svg = figure.querySelector("svg.wide");
    if (svg !== null) offer("SVG", () => download(`${name}.svg`, "image/svg+xml", standalone(svg)));
    figure.append(line);
  }
}

// The clipboard where the browser gives it to a page from disk, else the older way through a selection.
async function copyText(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    const field = element("textarea", "unseen");
    field.value = text;
    document.body.append(field);
    const focused = document.activeElement;
    field.select();
    const isCopied = document.execCommand("copy");
    field.remove();
    focused?.focus();
    return isCopied;
  }
}

// Copies and says so on the button for a moment.
async function copyWith(made, text) {
  const before = made.textContent;
  made.textContent = (await copyText(text)) ? "Copied" : "Select and copy";
  setTimeout(() => (made.textContent = before), 1500);
}

function addCopyButtons() {
  for (const code of document.querySelectorAll("code.copy")) {
    const made = button("copy-button", "Copy", "copy", () => copyWith(made, code.textContent));
    made.setAttribute("aria-label", `Copy: ${code.textContent.slice(0, 60)}`);
    code.after(made);
  }
}

// One tooltip for all terms, inside the window wherever the term stands; Escape closes it.
function addTips() {
  const tip = byId("tip");
  let shown = null;
  const hide = () => {
    tip.hidden = true;
    shown?.removeAttribute("aria-describedby");
    shown = null;
  };
  const place = () => {
    if (shown === null) return;
    const at = shown.getBoundingClientRect();
    const { width, height } = tip.getBoundingClientRect();
    const room = document.documentElement.clientWidth;
    tip.style.left = `${Math.max(8, Math.min(at.left, room - width - 8))}px`;
    tip.style.top = `${at.top > height + 12 ? at.top - height - 6 : at.bottom + 6}px`;
  };
  const show = (term) => {
    hide();
    shown = term;
    tip.textContent = term.dataset.definition;
    tip.hidden = false;
    term.setAttribute("aria-describedby", "tip");
    place();
  };
  for (const term of document.querySelectorAll(".term")) {
    for (const event of ["mouseenter", "focus", "click"]) term.addEventListener(event, () => show(term));
    for (const event of ["mouseleave", "blur"]) term.addEventListener(event, hide);
  }
  document.addEventListener("keydown", (event) => event.key === "Escape" && hide());
  window.addEventListener("scroll", place, { passive: true });
}

// Scrolls to a section and moves the focus there.
function goToSection(id) {
  const section = byId(id);
  if (section === null) return;
  section.scrollIntoView();
  section.querySelector("h2[tabindex]")?.focus({ preventScroll: true });
}
