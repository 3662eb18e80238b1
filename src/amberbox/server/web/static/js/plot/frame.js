// What surrounds the panels: tools, flags, lanes of states, the legend of gaps, the table of values.

import { breakableName, el, icon, setText, setTextAttribute } from "../dom.js";
import { t } from "../strings.js";
import { utcText } from "../time.js";
import { dateTime, elapsed, numberText } from "./axes.js";
import { GAP_KINDS, indexAt, panned, zoomed } from "./series.js";

const COLUMNS = ["value", "least", "mean", "greatest", "count", "shown"];

/** Make the table of values at the cursor and statistics of the window. @param {any} stack */
function valueTable(stack) {
  const time = el("span", { class: "plot-time" });
  const heads = COLUMNS.map((name) => el("th", { scope: "col", class: "num" }, t(`plot.${name}`)));
  const body = el("tbody");
  const element = el("table", { class: "table plot-readout" },
    el("caption", { class: "sr-only" }, t("plot.readout")),
    el("thead", {}, el("tr", {}, el("th", { scope: "col" }, t("plot.variable")), ...heads)), body);
  const scroll = el("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": t("plot.readout") }, element);
  return { stack, root: el("div", { class: "plot-values" }, time, scroll), time, body, rows: new Map() };
}

/** Update the rows of the table. */
export function updateValueTable(table, traces, time) {
  table.root.classList.toggle("is-bare", traces.length > 0 && traces.every((trace) => trace.request)); // these have no statistics
  for (const [id, row] of table.rows) {
    if (traces.some((trace) => trace.id === id)) continue;
    row.root.remove();
    table.rows.delete(id);
  }
  for (const trace of traces) {
    const row = table.rows.get(trace.id) ?? addTableRow(table, trace);
    row.swatch.style.background = table.stack.colours.now.plot[trace.colour];
    writeTableRow(row.cells, trace, time, table.stack.gapsOf(trace));
  }
}

/** Return the value of a variable at a time as text. @returns {{text: string, note: string}} */
export function valueAt(trace, time, gaps) {
  const gap = gaps.find((one) => one.from <= time && time < one.to);
  const series = trace.live && time >= trace.live.x[0] ? trace.live : trace.series;
  const place = series ? indexAt(series, time) : -1;
  if (gap && gap.kind !== "filtered" && !(place >= 0 && series.x[place] >= gap.from)) {
    return { text: "–", note: gap.kind === "refused" ? t("plot.hole.refused") : gap.reason };
  }
  if (place < 0) return { text: "–", note: "" };
  return valueOf(trace, series, place, time);
}

function valueOf(trace, series, place, time) {
  const isHeld = time - series.x[place] > series.silence;
  if (series.envelope) {
    if (isHeld || Number.isNaN(series.low[place])) return { text: "–", note: "" };
    const [low, high] = [series.low[place], series.high[place]].map((v) => valueName(trace, v, v));
    return { text: low === high ? low : `${low} … ${high}`, note: "" };
  }
  const isLast = place === series.x.length - 1;
  if (isHeld && isLast) return { text: "–", note: t("plot.nothing_since") };
  return { text: valueName(trace, series.low[place], series.raw[place]), note: isHeld ? t("plot.held") : "" };
}

/** Return a value, by its name if it has one. */
function valueName(trace, place, raw) {
  if (Number.isNaN(place)) return "–";
  return trace.names[place] === "" ? t("plot.empty_text") : trace.names[place] ?? numberText(raw);
}

function addTableRow(table, trace) {
  const swatch = el("span", { class: "plot-swatch", "aria-hidden": "true" });
  const cells = Object.fromEntries(COLUMNS.map((name) => [name, el("td", { class: "num nowrap" })]));
  const unit = trace.unit ? el("span", { class: "muted" }, ` ${trace.unit}`) : null;
  const head = el("th", { scope: "row" }, swatch, el("span", {}, ...breakableName(trace.label)), unit);
  const root = el("tr", {}, head, ...Object.values(cells));
  table.body.append(root);
  const row = { root, swatch, cells };
  table.rows.set(trace.id, row);
  return row;
}

function writeTableRow(cells, trace, time, gaps) {
  const { text, note } = time === null ? { text: "", note: "" } : valueAt(trace, time, gaps);
  setText(cells.value, note ? `${text} (${note})` : text);
  const statistics = trace.statistics;
  for (const [name, key] of [["least", "min"], ["mean", "mean"], ["greatest", "max"]]) {
    setText(cells[name], statistics ? statisticText(trace, key, statistics[key]) : "");
  }
  setText(cells.count, statistics ? (statistics.exact ? "" : "≈ ") + statistics.count.toLocaleString("en") : "");
  setText(cells.shown, samplingText(trace));
}

function statisticText(trace, key, value) {
  if (value === null || (key === "mean" && trace.names.length)) return "–";
  return trace.names[trace.codes.indexOf(value)] ?? numberText(value);
}

/** Return how many rows one point stands for as text; "" while nothing is loaded. */
export function samplingText(trace) {
  if (!trace.series) return "";
  const ratio = samplingRatio(trace);
  return ratio > 1 ? t("plot.aggregated", { n: ratio.toLocaleString("en") }) : t("plot.every");
}

/** Return how many rows one point stands for. */
export function samplingRatio({ series }) {
  if (!series || !series.x.length) return 1;
  return Math.max(1, Math.round(series.of / series.x.length));
}

const ICONS = { alarm: "bell", incident: "flag", mission: "robot", note: "note" };
// levels of lanes that are folded
const CALM_LEVELS = new Set(["ok", "unknown"]);
const LASTING_KINDS = new Set(["mission", "incident"]);
const FLAG_GROUP_PX = 28;
const FLAG_PX = 40;
const LETTER_PX = 6.5;

/** Make the strip of flags for what happened, and a list of the same. */
function flagStrip(stack) {
  const flags = el("div", { class: "plot-flags" });
  const list = el("ul", { class: "plot-list" });
  const summary = el("summary", {}, "");
  const details = el("details", { class: "plot-happened" }, summary, list);
  return { stack, flags, list, summary, details };
}

/** Show the marks of the window. @param {import("./load.js").Mark[]} marks */
function showFlags(strip, marks, width) {
  const { from, to } = strip.stack.view;
  const inside = marks.filter((mark) => mark.from <= to && (mark.to ?? mark.from) >= from);
  strip.flags.hidden = !marks.length;
  strip.details.hidden = !marks.length;
  const placed = inside.map((mark) => ({ mark, x: Math.max(0, ((mark.from - from) / (to - from)) * width) }));
  const lasting = inside.filter((mark) => LASTING_KINDS.has(mark.kind)).map((mark) => ({
    key: `span ${mark.id}`, make: () => el("span", { class: `plot-span plot-span-${mark.kind}`, "aria-hidden": "true" }), move: (element) => placeSpan(strip, element, mark, width),
  }));
  const groups = groupFlags(placed);
  updateChildren(strip.flags, [...lasting, ...groups.map((group) => ({
    key: group.map(({ mark }) => `${mark.id} ${mark.text} ${mark.to}`).join("\n"),
    make: () => flagElement(strip, group), move: (element) => placeFlag(element, group[0].x, width),
  }))]);
  setText(strip.summary, t("plot.happened", { n: inside.length }));
  updateChildren(strip.list, inside.map((mark) => ({
    key: `${mark.id} ${mark.text}`, make: () => el("li", {}, ...markLine(strip, mark)), move: () => undefined,
  })));
}

/**
 * Update the children of an element; those with the same key stay, keep the focus and are moved.
 * @param {HTMLElement} parent
 * @param {{key: string, make: function(): HTMLElement, move: function(HTMLElement): void}[]} wanted
 */
function updateChildren(parent, wanted) {
  const known = new Map([...parent.children].map((child) => [child.dataset.key, child]));
  const children = wanted.map(({ key, make, move }) => {
    const child = known.get(key) ?? make();
    child.dataset.key = key;
    move(child);
    return child;
  });
  const same = children.length === parent.children.length && children.every((child, n) => parent.children[n] === child);
  if (!same) parent.replaceChildren(...children);
}

/** Group flags that would cover each other. */
function groupFlags(placed) {
  const groups = [];
  for (const one of placed) {
    const last = groups[groups.length - 1];
    if (last && one.x - last[0].x < FLAG_GROUP_PX) last.push(one);
    else groups.push([one]);
  }
  return groups;
}

function flagElement(strip, group) {
  const [{ mark }] = group;
  const worst = group.find((one) => one.mark.kind === "alarm")?.mark ?? mark;
  const lines = group.map((one) => el("span", { class: "plot-flag-line" }, markText(strip, one.mark)));
  const tip = el("span", { class: "plot-tip" }, ...lines);
  const about = { class: `plot-flag plot-flag-${worst.kind}`, "aria-label": group.map((one) => markText(strip, one.mark)).join("; ") };
  const alone = group.length === 1 && mark.href;
  const made = el(alone ? "a" : "button", alone ? { ...about, href: mark.href } : { ...about, type: "button" },
    icon(ICONS[worst.kind]), group.length > 1 ? String(group.length) : null, tip);
  if (!alone) made.addEventListener("click", () => strip.stack.cursorTo(mark.from));
  return made;
}

function placeFlag(element, x, width) {
  const isLast = x > width - FLAG_PX;
  element.style.left = isLast ? "auto" : `${x}px`;
  element.style.right = isLast ? `${width - x}px` : "auto";
  element.classList.toggle("plot-flag-late", x > width / 2);
  element.classList.toggle("plot-flag-last", isLast);
}

function placeSpan({ stack }, element, mark, width) {
  const xOf = positionOn(stack.view, width);
  const left = xOf(mark.from);
  element.style.left = `${left}px`;
  element.style.width = `${Math.max(xOf(mark.to ?? stack.view.to) - left, 2)}px`;
}

/** Return a function for the position of times on a strip, clamped to its ends. */
function positionOn({ from, to }, width) {
  return (time) => ((Math.min(Math.max(time, from), to) - from) / (to - from)) * width;
}

function markText({ stack }, mark) {
  return `${timeText(stack, mark.from)} ${t(`plot.kind.${mark.kind}`)}: ${mark.text}`;
}

function markLine(strip, mark) {
  const goes = el("button", { type: "button", class: "button quiet small num", onclick: () => strip.stack.cursorTo(mark.from) },
    timeText(strip.stack, mark.from));
  const text = mark.href ? el("a", { href: mark.href }, mark.text) : mark.text;
  return [goes, " ", el("span", { class: "muted" }, `${t(`plot.kind.${mark.kind}`)}:`), " ", text];
}

function timeText({ options }, time) {
  return options.relative ? elapsed(time, 0.1) : dateTime(time, 1);
}

/** Make the lanes of states; those that were always fine are folded. */
function laneStrip(stack) {
  const troubled = el("div", { class: "plot-lanes" });
  const fine = el("div", { class: "plot-lanes" });
  const summary = el("summary", {}, "");
  const details = el("details", { class: "plot-fine" }, summary, fine);
  const root = el("div", { class: "plot-lanes" }, troubled, details);
  root.hidden = true;
  return { stack, root, troubled, fine, summary, details };
}

/** Show lanes. @param {import("./load.js").Lane[]} lanes */
function showLanes(strip, lanes, width) {
  const { from, to } = strip.stack.view;
  const isFine = (lane) => lane.stretches.every((one) => one.to <= from || one.from >= to || CALM_LEVELS.has(one.level));
  const [fine, troubled] = [lanes.filter(isFine), lanes.filter((lane) => !isFine(lane))];
  strip.root.hidden = !lanes.length;
  strip.details.hidden = !fine.length;
  setText(strip.summary, t("plot.fine", { n: fine.length }));
  for (const [root, some] of [[strip.troubled, troubled], [strip.fine, fine]]) {
    updateChildren(root, some.map((lane) => ({
      key: lane.id, make: () => laneElement(lane), move: (element) => fillLane(strip, element, lane, width),
    })));
  }
}

function laneElement(lane) {
  return el("div", { class: "plot-lane", role: "group", "aria-label": t("plot.states_of", { name: lane.label }) },
    el("span", { class: "plot-lane-name" }, lane.label), el("div", { class: "plot-lane-bar" }));
}

function fillLane({ stack }, element, lane, width) {
  const { from, to } = stack.view;
  const xOf = positionOn(stack.view, width);
  updateChildren(element.lastElementChild, lane.stretches.filter((one) => one.from < to && one.to > from).map((one) => ({
    key: `${one.from} ${one.to} ${one.text}`, make: () => stateElement(stack, one), move: (child) => placeState(child, one, xOf),
  })));
}

function stateElement(stack, one) {
  const text = `${one.text} · ${timeText(stack, one.from)} – ${timeText(stack, one.to)}`;
  return el("span", { class: `plot-state plot-state-${one.level}`, title: text, role: "img", "aria-label": text });
}

function placeState(element, one, xOf) {
  const left = xOf(one.from);
  const wide = Math.max(xOf(one.to) - left, 2);
  element.style.left = `${left}px`;
  element.style.width = `${wide}px`;
  setText(element, one.text.length * LETTER_PX < wide ? one.text : "");
}

const NO_VALUE = "–";

/** Make the frame of a stack of plots. @param {any} stack @param {HTMLElement} element */
export function plotFrame(stack, element) {
  const flags = flagStrip(stack);
  const lanes = laneStrip(stack);
  const values = valueTable(stack);
  const panels = el("div", { class: "plot-panels" });
  const spoken = el("p", { class: "sr-only", role: "status" });
  const help = el("p", { class: "sr-only", id: `${element.id || "plots"}-keys` }, t("plot.keys"));
  const gapLegend = el("ul", { class: "plot-holes", "aria-label": t("plot.missing") });
  const plots = el("div", { class: "plot-hands", tabindex: "0", role: "group", "aria-label": t("plot.plots"),
    "aria-describedby": help.id }, flags.flags, panels, lanes.root);
  const root = el("div", { class: "plots" }, toolbar(stack), help, plots, gapLegend, values.root, flags.details, spoken);
  element.append(root);
  return { root, plots, panels, flags, lanes, gapLegend, readout: values,
    say: () => setText(spoken, cursorText(stack)), showTime: () => showCursorTime(stack, values.time) };
}

/** Update flags, lanes and the legend of gaps. */
export function updateFrame(stack) {
  const { root, flags, lanes, gapLegend } = stack.frame;
  root.style.setProperty("--plot-left", `${stack.left()}px`);
  root.style.setProperty("--plot-inner", `${stack.plotWidth()}px`);
  showFlags(flags, stack.marks, stack.plotWidth());
  showLanes(lanes, stack.lanes, stack.plotWidth());
  const found = new Map();
  for (const trace of stack.traces.values()) {
    for (const gap of stack.gapsOf(trace)) {
      if (gap.to > stack.view.from && gap.from < stack.view.to) found.set(gap.kind, trace.robot);
    }
  }
  const isUnsure = stack.around.isUnsure();
  gapLegend.hidden = !found.size && !isUnsure;
  const key = [...found.keys(), isUnsure].sort().join();
  if (gapLegend.dataset.shown === key) return;
  gapLegend.dataset.shown = key;
  gapLegend.replaceChildren(...GAP_KINDS.filter((kind) => found.has(kind)).map((kind) => gapLegendEntry(kind, found.get(kind))),
  ...(isUnsure ? [el("li", {}, icon("info"), t("plot.unsure"))] : []));
}

/** Make the entry of a kind of gap; refused files get a link. @param {string} kind */
function gapLegendEntry(kind, robot) {
  const file = el("a", { href: `/recordings/${encodeURIComponent(robot)}?show=trouble#journals` }, t("plot.refused_file"));
  return el("li", {}, el("span", { class: `plot-hatch plot-hatch-${kind}`, "aria-hidden": "true" }), t(`plot.hole.${kind}`),
    kind === "refused" ? file : null);
}

function toolbar(stack) {
  const small = (name, inside, act) =>
    el("button", { type: "button", class: "button small icon-only", "aria-label": t(`plot.tool.${name}`),
      title: t(`plot.tool.${name}`), onclick: act }, inside);
  const worded = (name, act) =>
    el("button", { type: "button", class: "button small", title: t(`plot.tool.${name}_help`), onclick: act }, t(`plot.tool.${name}`));
  const to = ({ from, to }) => stack.window(from, to);
  const zoom = (factor) => to(zoomed(stack.view, factor, stack.cursor ?? undefined));
  return el("div", { class: "plot-tools no-print", role: "toolbar", "aria-label": t("plot.tools") },
    small("earlier", icon("back"), () => to(panned(stack.view, -0.5))),
    small("later", icon("next"), () => to(panned(stack.view, 0.5))),
    small("out", "−", () => zoom(2)), small("in", "+", () => zoom(0.5)),
    worded("all", () => stack.all()), worded("back", () => stack.back()));
}

function showCursorTime(stack, element) {
  const { cursor, options, view } = stack;
  const step = (view.to - view.from) / 5000;
  if (cursor === null) {
    setText(element, t("plot.no_cursor"));
    element.removeAttribute("title");
    return;
  }
  const text = options.relative ? elapsed(cursor, step) : dateTime(cursor, step);
  setText(element, t("plot.at", { time: text }));
  if (!options.relative) setTextAttribute(element, "title", utcText(1000 * cursor));
}

/** Return the values at the cursor as a sentence for screen readers. */
function cursorText(stack) {
  const { cursor, options } = stack;
  const values = [...stack.traces.values()].map((trace) => {
    const { text, note } = valueAt(trace, cursor, stack.gapsOf(trace));
    return [trace.label, text, text === NO_VALUE ? "" : trace.unit, note && `(${note})`].filter(Boolean).join(" ");
  });
  return [options.relative ? elapsed(cursor, 0.1) : dateTime(cursor, 0.1), ...values].join("; ");
}
