// A panel of a plot: its legend, axes, and what is drawn in it.

import { breakableName, el, icon, setText } from "../dom.js";
import { t } from "../strings.js";
import { axisWidth, TIME_HEIGHT, timeAxis, valueAxis } from "./axes.js";
import { drawGap, drawMarkLine, drawSeries } from "./draw.js";
import { samplingRatio, samplingText, valueAt } from "./frame.js";
import { extremes, gapKindOver, partInWindow } from "./series.js";

/** Make the legend entry of a variable. @param {any} panel @param {Trace} trace */
export function legendEntry(panel, trace) {
  const { stack } = panel;
  const swatch = el("span", { class: "plot-swatch", "aria-hidden": "true" });
  const value = el("span", { class: "plot-value num" });
  const badge = el("span", { class: "badge plot-badge" });
  const problem = el("span", { class: "plot-problem", role: "alert" });
  const remove = el("button", {
    type: "button", class: "button quiet small icon-only no-print",
    "aria-label": t("plot.remove", { name: trace.label }), title: t("plot.remove", { name: trace.label }),
    onclick: () => stack.drop(trace.id),
  }, icon("close"));
  const name = trace.unit ? `${trace.label} [${trace.unit}]` : trace.label;
  const root = el("li", { class: "plot-key" }, swatch, el("span", { class: "plot-name" }, ...breakableName(name)), value, badge,
    problem, stack.options.fixed ? null : remove);
  for (const [event, id] of [["pointerenter", trace.id], ["pointerleave", ""]]) {
    root.addEventListener(event, () => stack.strengthen(panel, id));
  }
  return { root, swatch, value, badge, problem };
}

/** Update value, sampling and problem of a legend entry. */
export function updateLegendEntry(key, trace, stack) {
  key.swatch.style.background = stack.colours.now.plot[trace.colour];
  const time = stack.cursor;
  const { text, note } = time === null ? { text: "", note: "" } : valueAt(trace, time, stack.gapsOf(trace));
  setText(key.value, note ? `${text} (${note})` : text);
  key.badge.hidden = samplingRatio(trace) === 1;
  setText(key.badge, samplingText(trace));
  setText(key.problem, problemOf(trace, stack));
  key.problem.hidden = !key.problem.textContent;
  key.root.classList.toggle("plot-waiting", !trace.series && !trace.problem);
}

function problemOf(trace, stack) {
  const { problem, series, live } = trace;
  if (problem) return problem.hint ? `${problem.message}. ${problem.hint}` : problem.message;
  if (!series || series.x.length || live) return "";
  const kind = gapKindOver(stack.gapsOf(trace), partInWindow(trace, stack.view));
  return kind ? t("plot.none_because", { why: t(`plot.hole.${kind}`) }) : t("plot.none_here");
}

/**
 * uPlot draws axes, cursor and selection of a panel; the variables are drawn by this module, from
 * their own rows, so that they need not share their times.
 *
 * @typedef {object} Trace a variable that is shown
 * @property {string} id @property {string} robot @property {string} item @property {string} variable
 * @property {string} label @property {string} unit @property {string} panel
 * @property {"number"|"words"} kind @property {string[]} names what numbers mean, where they do
 * @property {number} colour the number of its colour @property {number} origin seconds
 * @property {?import("./series.js").Series} series what was loaded
 * @property {?import("./series.js").Series} live what came since
 */

const HEIGHT = 190;
const WORDS_HEIGHT = 26;
/** Pixels between the plot and the right edge of a panel. */
export const EDGE_PX = 20;
const MARGIN = 0.06;

/**
 * Make a panel.
 * @param {any} stack what all panels share: view, colours, options, cursor
 * @param {string} name
 */
export function makePanel(stack, name) {
  const legend = el("ul", { class: "plot-keys" });
  const box = el("div", { class: "plot-canvas" });
  const root = el("section", { class: "plot-panel" }, legend, box);
  return { stack, name, root, legend, box, traces: [], chart: null, drawn: "", strong: "", patterns: new Map() };
}

/** Return the key of the scale of a variable: variables of one unit share one. */
function scaleOf(trace) {
  return trace.names.length ? `names ${trace.names.join("\n")}` : `unit ${trace.unit}`;
}

/** Return the scales of a panel; the axis of the first is at the left. */
export function scalesOf(panel) {
  return [...new Set(panel.traces.map(scaleOf))];
}

/** Rebuild the chart if its axes or its size have changed. */
export function fitPanel(panel, about) {
  const key = JSON.stringify([scalesOf(panel), about]);
  if (panel.drawn === key) return;
  panel.drawn = key;
  panel.chart?.destroy();
  const { from, to } = panel.stack.view;
  const noData = [[from, to], ...scalesOf(panel).map(() => [null, null])];
  panel.chart = new window.uPlot(optionsOf(panel, about), noData, panel.box);
  panel.box.querySelector("canvas").setAttribute("aria-hidden", "true");
}

/** Draw a panel for the current window. */
export function drawPanel(panel) {
  const { chart, stack } = panel;
  if (!chart) return;
  const { from, to } = stack.view;
  chart.batch(() => {
    chart.setScale("x", { min: from, max: to });
    for (const scale of scalesOf(panel)) {
      const [min, max] = rangeOf(panel, scale);
      chart.setScale(scale, { min, max });
    }
  });
  chart.redraw(false);
}

export function destroyPanel(panel) {
  panel.chart?.destroy();
  panel.root.remove();
}

/** Show the common cursor in a panel. @param {?number} time */
export function pointPanel(panel, time) {
  const { chart } = panel;
  if (!chart) return;
  const left = time === null ? -10 : chart.valToPos(time, "x");
  chart.setCursor({ left, top: time === null ? -10 : 0 }, false);
}

function optionsOf(panel, { width, rights, last, narrow }) {
  const { stack } = panel;
  const scales = scalesOf(panel);
  const names = scales.map((scale) => panel.traces.find((one) => scaleOf(one) === scale).names
    .map((name) => name || t("plot.empty_text")));
  const own = axisWidth(narrow) * (rights - (scales.length - 1));
  return {
    width, height: heightOf(names) + (last ? TIME_HEIGHT : 8),
    padding: [6, EDGE_PX + own, 0, 0],
    legend: { show: false },
    scales: Object.fromEntries([
      ["x", { time: !stack.options.relative, auto: false, range: (_, min, max) => [min, max] }],
      ...scales.map((scale) => [scale, { auto: false, range: () => rangeOf(panel, scale) }]),
    ]),
    series: [{}, ...scales.map((scale) => ({ scale, paths: () => null, points: { show: false } }))],
    axes: axesOf(panel, scales, names, narrow, last),
    cursor: {
      points: { show: false }, y: false, lock: false,
      drag: { x: true, y: false, setScale: false, dist: 4 },
      bind: { dblclick: () => null },
    },
    hooks: hooksOf(panel),
  };
}

function axesOf(panel, scales, names, narrow, last) {
  const { colours, options } = panel.stack;
  const look = { ink: () => colours.now.ink, line: () => colours.now.line };
  return [
    timeAxis({ relative: Boolean(options.relative), hasLabels: last, ...look }),
    ...scales.map((scale, n) => valueAxis({
      scale, unit: names[n].length ? "" : scale.slice("unit ".length), first: n === 0, narrow,
      words: names[n], ...look,
    })),
  ];
}

function heightOf(names) {
  if (!names.every((names) => names.length)) return HEIGHT;
  const most = Math.max(...names.map((names) => names.length));
  return Math.min(HEIGHT, 24 + WORDS_HEIGHT * most);
}

function hooksOf(panel) {
  const { stack } = panel;
  return {
    drawClear: [() => drawBackground(panel)],
    draw: [() => drawTraces(panel)],
    setCursor: [(chart) => {
      if (chart.cursor.left >= 0) stack.pointed(chart.posToVal(chart.cursor.left, "x"), panel);
      else stack.redraw(); // the cursor stays where the mouse left
    }],
    setSelect: [(chart) => {
      const { left, width } = chart.select;
      if (width < 2) return;
      const [from, to] = [left, left + width].map((px) => chart.posToVal(px, "x"));
      chart.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
      stack.zoom(from, to);
    }],
  };
}

/** @returns {import("./draw.js").Frame} */
function canvasFrame(panel, scale) {
  const { chart, stack } = panel;
  const { left, top, width, height } = chart.bbox;
  const { min = 0, max = 1 } = scale ? chart.scales[scale] : {};
  return { context: chart.ctx, left, top, width, height, low: min, high: max, dpr: window.devicePixelRatio,
    ...stack.view };
}

function drawBackground(panel) {
  const { stack } = panel;
  const frame = canvasFrame(panel, null);
  const seen = new Set();
  for (const trace of panel.traces) {
    for (const gap of stack.gapsOf(trace)) {
      const own = stack.options.relative ? stack.colours.now.plot[trace.colour] : "";
      const key = `${gap.from} ${gap.to} ${gap.kind} ${own}`;
      if (!seen.has(key)) drawGap(frame, gap, { colours: stack.colours.now, own, patterns: panel.patterns });
      seen.add(key);
    }
  }
  for (const mark of stack.marks) drawMarkLine(frame, mark.from, stack.colours.now.ink2);
}

function drawTraces(panel) {
  const { stack } = panel;
  for (const trace of panel.traces) {
    const frame = canvasFrame(panel, scaleOf(trace));
    const breaks = stack.gapsOf(trace).filter((gap) => gap.kind !== "filtered");
    const look = {
      colour: stack.colours.now.plot[trace.colour], steps: trace.names.length > 0, breaks,
      strong: panel.strong === trace.id, sure: stack.gaps.reach(trace),
    };
    for (const series of [trace.series, trace.live]) {
      if (series?.x.length) drawSeries(frame, series, look);
    }
  }
}

/** Return least and greatest value of a scale in the window, with a margin. */
function rangeOf(panel, scale) {
  const traces = panel.traces.filter((trace) => scaleOf(trace) === scale);
  const names = traces[0]?.names ?? [];
  if (names.length) return [-0.5, names.length - 0.5];
  const { from, to } = panel.stack.view;
  const found = traces.flatMap((trace) => [trace.series, trace.live])
    .map((series) => series && extremes(series, from, to)).filter(Boolean);
  if (!found.length) return [0, 1];
  const low = Math.min(...found.map(([least]) => least));
  const high = Math.max(...found.map(([, most]) => most));
  const more = (high - low) * MARGIN || Math.abs(high) * MARGIN || 1;
  return [low - more, high + more];
}
