/** What stands around the panels: buttons, flags, lanes, the legend of hatching, the table. */

import { el, icon, setText, setWords } from "../dom.js";
import { KINDS } from "./gaps.js";
import { flagStrip, laneStrip, showFlags, showLanes } from "./strips.js";
import { readout, valueAt } from "./table.js";
import { moment, since, utc } from "./time.js";
import { panned, zoomed } from "./view.js";
import { t } from "../strings.js";

const NOTHING = "–";

/** Make the frame of a stack. @param {any} stack @param {HTMLElement} element */
export function frameOf(stack, element) {
  const flags = flagStrip(stack);
  const lanes = laneStrip(stack);
  const values = readout(stack);
  const panels = el("div", { class: "plot-panels" });
  const spoken = el("p", { class: "sr-only", role: "status" });
  const help = el("p", { class: "sr-only", id: `${element.id || "plots"}-keys` }, t("plot.keys"));
  const holes = el("ul", { class: "plot-holes", "aria-label": t("plot.missing") });
  const plots = el("div", { class: "plot-hands", tabindex: "0", role: "group", "aria-label": t("plot.plots"),
    "aria-describedby": help.id }, flags.flags, panels, lanes.root);
  const root = el("div", { class: "plots" }, tools(stack), help, plots, holes, values.root, flags.details, spoken);
  element.append(root);
  return { root, plots, panels, flags, lanes, holes, readout: values,
    say: () => setText(spoken, sentence(stack)), showTime: () => showTime(stack, values.time) };
}

/** Bring flags, lanes and the legend of hatching up to date. */
export function showAround(stack) {
  const { root, flags, lanes, holes } = stack.frame;
  root.style.setProperty("--plot-left", `${stack.left()}px`);
  root.style.setProperty("--plot-inner", `${stack.plotWidth()}px`);
  showFlags(flags, stack.marks, stack.plotWidth());
  showLanes(lanes, stack.lanes, stack.plotWidth());
  const found = new Map();
  for (const trace of stack.traces.values()) {
    for (const hole of stack.gapsOf(trace)) {
      if (hole.to > stack.view.from && hole.from < stack.view.to) found.set(hole.kind, trace.robot);
    }
  }
  const isUnsure = stack.around.isUnsure();
  holes.hidden = !found.size && !isUnsure;
  const key = [...found.keys(), isUnsure].sort().join();
  if (holes.dataset.shown === key) return;
  holes.dataset.shown = key;
  holes.replaceChildren(...KINDS.filter((kind) => found.has(kind)).map((kind) => holeKey(kind, found.get(kind))),
  ...(isUnsure ? [el("li", {}, icon("info"), t("plot.unsure"))] : []));
}

/** What a hatching means; files that were refused one can look at. @param {string} kind */
function holeKey(kind, robot) {
  const file = el("a", { href: `/recordings/${encodeURIComponent(robot)}?show=trouble#journals` }, t("plot.refused_file"));
  return el("li", {}, el("span", { class: `plot-hatch plot-hatch-${kind}`, "aria-hidden": "true" }), t(`plot.hole.${kind}`),
    kind === "refused" ? file : null);
}

function tools(stack) {
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

function showTime(stack, element) {
  const { cursor, options, view } = stack;
  const step = (view.to - view.from) / 5000;
  if (cursor === null) {
    setText(element, t("plot.no_cursor"));
    element.removeAttribute("title");
    return;
  }
  const text = options.relative ? since(cursor, step) : moment(cursor, step);
  setText(element, t("plot.at", { time: text }));
  if (!options.relative) setWords(element, "title", utc(cursor));
}

/** The values at the cursor, for those who listen. */
function sentence(stack) {
  const { cursor, options } = stack;
  const values = [...stack.traces.values()].map((trace) => {
    const { text, note } = valueAt(trace, cursor, stack.gapsOf(trace));
    return [trace.label, text, text === NOTHING ? "" : trace.unit, note && `(${note})`].filter(Boolean).join(" ");
  });
  return [options.relative ? since(cursor, 0.1) : moment(cursor, 0.1), ...values].join("; ");
}
