/**
 * One panel: variables over time, an axis for each unit. uPlot gives axes, cursor and selection;
 * what is drawn comes from each variable's own rows, so that they need not share their times.
 *
 * @typedef {object} Trace a variable that is shown
 * @property {string} id @property {string} robot @property {string} item @property {string} variable
 * @property {string} label @property {string} unit @property {string} panel
 * @property {"number"|"words"} kind @property {string[]} names what numbers mean, where they do
 * @property {number} colour the number of its colour @property {number} origin seconds
 * @property {?import("./data.js").Series} series what was loaded
 * @property {?import("./data.js").Series} live what came since
 */

import { TIME_HEIGHT, axisWidth, timeAxis, valueAxis } from "./axes.js";
import { el } from "../dom.js";
import { extremes } from "./data.js";
import { t } from "../strings.js";
import { drawMoment, drawSeries } from "./draw.js";
import { drawStretch } from "./hatching.js";

const HEIGHT = 190;
const WORDS_HEIGHT = 26;
/** Pixels between the plot and the right edge of a panel. */
export const EDGE = 20;
const MARGIN = 0.06;

/**
 * Make a panel.
 * @param {any} stack what all panels share: view, colours, options, cursor
 * @param {string} name
 */
export function panel(stack, name) {
  const legend = el("ul", { class: "plot-keys" });
  const box = el("div", { class: "plot-canvas" });
  const root = el("section", { class: "plot-panel" }, legend, box);
  return { stack, name, root, legend, box, traces: [], chart: null, drawn: "", strong: "", patterns: new Map() };
}

/** Name the scale of a variable: variables of one unit share one. */
export function scaleOf(trace) {
  return trace.names.length ? `names ${trace.names.join("\n")}` : `unit ${trace.unit}`;
}

/** The scales of a panel, the first one at the left. */
export function scalesOf(shown) {
  return [...new Set(shown.traces.map(scaleOf))];
}

/** Build the chart anew where other axes are needed; set its size. */
export function fit(shown, about) {
  const key = JSON.stringify([scalesOf(shown), about]);
  if (shown.drawn === key) return;
  shown.drawn = key;
  shown.chart?.destroy();
  shown.chart = new window.uPlot(optionsOf(shown, about), emptyData(shown), shown.box);
  describe(shown);
}

/** Draw a panel with the window as it is now. */
export function draw(shown) {
  const { chart, stack } = shown;
  if (!chart) return;
  const { from, to } = stack.view;
  chart.batch(() => {
    chart.setScale("x", { min: from, max: to });
    for (const scale of scalesOf(shown)) {
      const [min, max] = rangeOf(shown, scale);
      chart.setScale(scale, { min, max });
    }
  });
  chart.redraw(false);
}

/** Let go of a panel. */
export function destroy(shown) {
  shown.chart?.destroy();
  shown.root.remove();
}

/** Show the cursor of all panels in this one. @param {?number} time */
export function point(shown, time) {
  const { chart } = shown;
  if (!chart) return;
  const left = time === null ? -10 : chart.valToPos(time, "x");
  chart.setCursor({ left, top: time === null ? -10 : 0 }, false);
}

function describe(shown) {
  const canvas = shown.box.querySelector("canvas");
  canvas.setAttribute("aria-hidden", "true");
}

function emptyData(shown) {
  const { from, to } = shown.stack.view;
  return [[from, to], ...scalesOf(shown).map(() => [null, null])];
}

function optionsOf(shown, { width, rights, last, narrow }) {
  const { stack } = shown;
  const scales = scalesOf(shown);
  const words = scales.map((scale) => shown.traces.find((one) => scaleOf(one) === scale).names
    .map((name) => name || t("plot.empty_text")));
  const own = axisWidth(narrow) * (rights - (scales.length - 1));
  return {
    width, height: heightOf(words) + (last ? TIME_HEIGHT : 8),
    padding: [6, EDGE + own, 0, 0],
    legend: { show: false },
    scales: Object.fromEntries([
      ["x", { time: !stack.options.relative, auto: false, range: (_, min, max) => [min, max] }],
      ...scales.map((scale) => [scale, { auto: false, range: () => rangeOf(shown, scale) }]),
    ]),
    series: [{}, ...scales.map((scale) => ({ scale, paths: () => null, points: { show: false } }))],
    axes: axesOf(shown, scales, words, narrow, last),
    cursor: {
      points: { show: false }, y: false, lock: false,
      drag: { x: true, y: false, setScale: false, dist: 4 },
      bind: { dblclick: () => null },
    },
    hooks: hooksOf(shown),
  };
}

function axesOf(shown, scales, words, narrow, last) {
  const { colours, options } = shown.stack;
  const look = { ink: () => colours.now.ink, line: () => colours.now.line };
  return [
    timeAxis({ relative: Boolean(options.relative), shown: last, ...look }),
    ...scales.map((scale, n) => valueAxis({
      scale, unit: words[n].length ? "" : scale.slice("unit ".length), first: n === 0, narrow,
      words: words[n], ...look,
    })),
  ];
}

function heightOf(words) {
  if (!words.every((names) => names.length)) return HEIGHT;
  const most = Math.max(...words.map((names) => names.length));
  return Math.min(HEIGHT, 24 + WORDS_HEIGHT * most);
}

function hooksOf(shown) {
  const { stack } = shown;
  return {
    drawClear: [() => drawBehind(shown)],
    draw: [() => drawTraces(shown)],
    setCursor: [(chart) => {
      if (chart.cursor.left >= 0) stack.pointed(chart.posToVal(chart.cursor.left, "x"), shown);
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
function frameOf(shown, scale) {
  const { chart, stack } = shown;
  const { left, top, width, height } = chart.bbox;
  const { min = 0, max = 1 } = scale ? chart.scales[scale] : {};
  return { context: chart.ctx, left, top, width, height, low: min, high: max, dpr: window.devicePixelRatio,
    ...stack.view };
}

function drawBehind(shown) {
  const { stack } = shown;
  const frame = frameOf(shown, null);
  const seen = new Set();
  for (const trace of shown.traces) {
    for (const gap of stack.gapsOf(trace)) {
      const own = stack.options.relative ? stack.colours.now.plot[trace.colour] : "";
      const key = `${gap.from} ${gap.to} ${gap.kind} ${own}`;
      if (!seen.has(key)) drawStretch(frame, gap, { colours: stack.colours.now, own, patterns: shown.patterns });
      seen.add(key);
    }
  }
  for (const mark of stack.marks) drawMoment(frame, mark.from, stack.colours.now.ink2);
}

function drawTraces(shown) {
  const { stack } = shown;
  for (const trace of shown.traces) {
    const frame = frameOf(shown, scaleOf(trace));
    const breaks = stack.gapsOf(trace).filter((gap) => gap.kind !== "filtered");
    const look = {
      colour: stack.colours.now.plot[trace.colour], steps: trace.names.length > 0, breaks,
      strong: shown.strong === trace.id, sure: stack.gaps.reach(trace),
    };
    for (const series of [trace.series, trace.live]) {
      if (series?.x.length) drawSeries(frame, series, look);
    }
  }
}

/** Least and greatest value of a scale in the window, and a little more. */
function rangeOf(shown, scale) {
  const traces = shown.traces.filter((trace) => scaleOf(trace) === scale);
  const names = traces[0]?.names ?? [];
  if (names.length) return [-0.5, names.length - 0.5];
  const { from, to } = shown.stack.view;
  const found = traces.flatMap((trace) => [trace.series, trace.live])
    .map((series) => series && extremes(series, from, to)).filter(Boolean);
  if (!found.length) return [0, 1];
  const low = Math.min(...found.map(([least]) => least));
  const high = Math.max(...found.map(([, most]) => most));
  const more = (high - low) * MARGIN || Math.abs(high) * MARGIN || 1;
  return [low - more, high + more];
}
