// Figures that are not over time: XY views and histograms, on a canvas with axes.

import { latestSignal, requestColumns, requestJson, robotApi } from "../api.js";
import { el, escapeHidden, setText, setTextAttribute } from "../dom.js";
import { t } from "../strings.js";
import { secondsParam } from "../time.js";
import { dateTime, FONT, numberText, scaled } from "./axes.js";
import { onThemeChange, readColours } from "./draw.js";
import { firstIndexFrom, indexAt, seriesOf } from "./series.js";

const LEFT = scaled(64);
const RIGHT = 16;
const TOP = 12;
const BOTTOM = scaled(44);
const STEPS = [1, 2, 2.5, 5, 10];
const MARGIN = 0.05;

/**
 * Make a figure that fills its element's width.
 * @param {HTMLElement} element
 * @param {{height: number, label: string, draw: function(any): void}} options `draw` gets a pen with
 *   `context`, `colours`, `width`, `height`, and `axes(...)`, which returns where values lie
 */
function figure(element, { height, label, draw }) {
  const end = new AbortController();
  const canvas = el("canvas", { role: "img", "aria-label": label });
  const root = el("figure", { class: "plot-figure" }, canvas);
  element.append(root);
  const redraw = () => {
    const width = root.clientWidth;
    if (width) draw(penOf(canvas, width, height, readColours(root)));
  };
  const watcher = new ResizeObserver(redraw);
  watcher.observe(root);
  onThemeChange(redraw, end.signal);
  const describe = (text) => setTextAttribute(canvas, "aria-label", text);
  function destroy() {
    end.abort();
    watcher.disconnect();
    root.remove();
  }
  return { root, canvas, redraw, describe, destroy };
}

function penOf(canvas, width, height, shades) {
  const dpr = window.devicePixelRatio;
  canvas.width = Math.round(width * dpr);
  canvas.height = Math.round(height * dpr);
  canvas.style.height = `${height}px`;
  const context = canvas.getContext("2d");
  context.setTransform(dpr, 0, 0, dpr, 0, 0);
  context.font = FONT;
  return { context, colours: shades, width, height, axes: (x, y) => drawAxes(context, shades, width, height, x, y) };
}

/**
 * Draw axes. @param {{low: number, high: number, label: string,
 *   names?: [number, string][]}} x `names` of values stand where numbers would @param {typeof x} y
 * @returns {{x: function(number): number, y: function(number): number, bottom: number}}
 */
function drawAxes(context, shades, width, height, x, y) {
  const right = width - RIGHT;
  const bottom = height - BOTTOM;
  const place = {
    x: (value) => LEFT + ((value - x.low) / (x.high - x.low)) * (right - LEFT),
    y: (value) => bottom - ((value - y.low) / (y.high - y.low)) * (bottom - TOP),
    bottom,
  };
  context.strokeStyle = shades.line;
  context.fillStyle = shades.ink;
  context.lineWidth = 1;
  const names = x.names && new Map(x.names);
  for (const value of names?.keys() ?? ticks(x.low, x.high, (right - LEFT) / scaled(80))) {
    const at = Math.round(place.x(value)) + 0.5;
    drawRule(context, at, TOP, at, bottom);
    writeText(context, names?.get(value) ?? numberText(value), at, bottom + scaled(16), "center");
  }
  for (const value of ticks(y.low, y.high, (bottom - TOP) / scaled(34))) {
    const at = Math.round(place.y(value)) + 0.5;
    drawRule(context, LEFT, at, right, at);
    writeText(context, numberText(value), LEFT - 6, at + scaled(4), "right");
  }
  writeText(context, x.label, (LEFT + right) / 2, height - 8, "center");
  context.save();
  context.translate(scaled(12), (TOP + bottom) / 2);
  context.rotate(-Math.PI / 2);
  writeText(context, y.label, 0, 0, "center");
  context.restore();
  return place;
}

/** Return a range with a margin around it. */
function withMargin(low, high) {
  const more = (high - low) * MARGIN || Math.abs(high) * MARGIN || 1;
  return { low: low - more, high: high + more };
}

function ticks(low, high, most) {
  const rough = (high - low) / Math.max(most, 1);
  const size = 10 ** Math.floor(Math.log10(rough));
  const step = size * STEPS.find((one) => one * size >= rough);
  const first = Math.ceil(low / step);
  const last = Math.floor(high / step);
  return Array.from({ length: Math.max(last - first + 1, 0) }, (_, n) => Number(((first + n) * step).toPrecision(12)));
}

function drawRule(context, x1, y1, x2, y2) {
  context.beginPath();
  context.moveTo(x1, y1);
  context.lineTo(x2, y2);
  context.stroke();
}

function writeText(context, text, x, y, align) {
  context.textAlign = align;
  context.fillText(escapeHidden(String(text)), x, y);
}

const XY_POINTS = 4000;
const XY_HEIGHT = 420;
const XY_SHADES = 24;
const XY_DOT = 2.2;

/**
 * Show one variable against another, coloured from early to late; returns `update(from, to)` and `destroy()`.
 * @param {HTMLElement} element
 * @param {{x: import("./plot.js").TraceOptions, y: import("./plot.js").TraceOptions, from: number, to: number}} about
 */
export function xyView(element, { x, y, from, to }) {
  const state = { from, to, points: null };
  const nextSignal = latestSignal();
  const shown = figure(element, { height: XY_HEIGHT, label: t("plot.xy", { x: titleOf(x), y: titleOf(y) }),
    draw: (pen) => drawXy(pen, state, x, y) });
  const legend = el("p", { class: "row small muted" });
  const note = el("p", { class: "small muted", role: "status" });
  shown.root.append(el("figcaption", {}, legend, note));

  /** Show another window. Throws ApiError. */
  async function update(begin, end) {
    const signal = nextSignal();
    const [first, second] = await Promise.all([x, y].map((one) => loadXy(one, begin, end, signal)));
    Object.assign(state, { from: begin, to: end, points: pairValues(first, second) });
    legend.replaceChildren(dateTime(begin, 1), " ", el("span", { class: "plot-ramp", "aria-hidden": "true" }), " ", dateTime(end, 1));
    setText(note, xyNote(state.points, first, second));
    shown.redraw();
  }

  return { update, destroy: shown.destroy, ready: update(from, to) };
}

async function loadXy(one, from, to, signal) {
  const query = new URLSearchParams({ item: one.item, variables: one.variable, from: secondsParam(from), to: secondsParam(to),
    points: XY_POINTS, format: "plot" });
  return seriesOf(await requestColumns(`${robotApi(one.robot)}/query?${query}`, { signal }));
}

/** Pair each value of the variable with fewer rows with the value of the other at that time. */
function pairValues(first, second) {
  const isFirst = first.x.length <= second.x.length;
  const [few, many] = isFirst ? [first, second] : [second, first];
  const found = [];
  few.x.forEach((time, n) => {
    const value = interpolateAt(many, time);
    const own = few.mean[n];
    if (!Number.isNaN(value) && !Number.isNaN(own)) found.push(isFirst ? [own, value, time] : [value, own, time]);
  });
  return found;
}

/** Interpolate the value at a time; NaN without rows nearby. */
function interpolateAt(series, time) {
  const before = indexAt(series, time);
  const behind = firstIndexFrom(series.x, time);
  if (before < 0 || time - series.x[before] > series.silence) return NaN;
  if (behind >= series.x.length || behind === before || series.x[behind] - series.x[before] > series.silence) return series.mean[before];
  const part = (time - series.x[before]) / (series.x[behind] - series.x[before]);
  return series.mean[before] + part * (series.mean[behind] - series.mean[before]);
}

function xyNote(points, first, second) {
  if (!points.length) return t("plot.xy_none");
  const of = Math.max(first.of, second.of);
  return of > 1.5 * points.length ? t("plot.xy_thinned", { n: points.length.toLocaleString("en"), of: of.toLocaleString("en") })
    : t("plot.xy_points", { n: points.length.toLocaleString("en") });
}

function drawXy(pen, { points, from, to }, x, y) {
  if (!points?.length) return;
  const range = (k) => {
    const values = points.map((point) => point[k]);
    return withMargin(values.reduce((a, b) => Math.min(a, b)), values.reduce((a, b) => Math.max(a, b)));
  };
  const place = pen.axes({ ...range(0), label: titleOf(x) }, { ...range(1), label: titleOf(y) });
  const shades = timeRamp(pen.colours);
  const { context } = pen;
  for (const [across, up, time] of points) {
    const shade = Math.min(XY_SHADES - 1, Math.max(0, Math.floor(((time - from) / (to - from)) * XY_SHADES)));
    context.fillStyle = shades[shade];
    context.beginPath();
    context.arc(place.x(across), place.y(up), XY_DOT, 0, 2 * Math.PI);
    context.fill();
  }
}

/** Return colours from early to late, as in `.plot-ramp` of the style sheet. */
function timeRamp({ plot }) {
  const ends = [plot[5], plot[3], plot[1]];
  return Array.from({ length: XY_SHADES }, (_, n) => {
    const part = (n / (XY_SHADES - 1)) * 2;
    const first = Math.min(Math.floor(part), 1);
    return `color-mix(in srgb, ${ends[first + 1]} ${Math.round((part - first) * 100)}%, ${ends[first]})`;
  });
}

const titleOf = (one) => (one.unit ? `${one.label ?? one.variable} [${one.unit}]` : one.label ?? one.variable);

const BARS_HEIGHT = 300;
const BARS = 50;

/**
 * Show a histogram inside an element; returns `update(from, to)` and `destroy()`.
 * @param {HTMLElement} element
 * @param {{trace: import("./plot.js").TraceOptions, from: number, to: number}} about
 */
export function histogram(element, { trace, from, to }) {
  const state = { bars: null };
  const nextSignal = latestSignal();
  const title = trace.label ?? trace.variable;
  const name = trace.unit ? `${title} [${trace.unit}]` : title;
  const shown = figure(element, { height: BARS_HEIGHT, label: t("plot.histogram", { name }),
    draw: (pen) => drawBars(pen, state.bars, name, trace.labels ?? {}) });
  const note = el("p", { class: "small muted", role: "status" });
  const list = el("table", {});
  shown.root.append(el("figcaption", {}, note), el("div", { class: "sr-only" }, list));

  /** Show another window. Throws ApiError. */
  async function update(begin, end) {
    const found = await loadBars(trace, begin, end, nextSignal());
    const statistics = found.variables[0];
    state.bars = statistics?.histogram ?? null;
    setText(note, t(barsNote(statistics, found.exact), { n: (statistics?.count ?? 0).toLocaleString("en") }));
    list.replaceChildren(el("caption", {}, t("plot.histogram", { name })), ...barRows(state.bars, trace));
    shown.redraw();
  }

  return { update, destroy: shown.destroy, ready: update(from, to) };
}

function loadBars(trace, from, to, signal) {
  const query = new URLSearchParams({ item: trace.item, variables: trace.variable, from: secondsParam(from), to: secondsParam(to), bins: BARS });
  return requestJson(`${robotApi(trace.robot)}/statistics?${query}`, { signal });
}

function barsNote(statistics, exact) {
  if (!statistics?.count) return "plot.none_here";
  return exact ? "plot.histogram_of" : "plot.histogram_steps";
}

function drawBars(pen, bars, name, labels) {
  if (!bars) return;
  const { edges, counts } = bars;
  const most = counts.reduce((high, count) => Math.max(high, count), 1);
  const [low, high] = [edges[0], edges[edges.length - 1]];
  const named = Object.entries(labels).map(([value, text]) => [Number(value), text]);
  const names = named.length ? named.filter(([value]) => value > low && value < high) : undefined;
  const place = pen.axes({ low, high, label: name, names },
    { low: 0, high: most * 1.05, label: t("plot.count") });
  pen.context.fillStyle = pen.colours.plot[0];
  counts.forEach((count, n) => {
    const left = place.x(edges[n]);
    const top = place.y(count);
    pen.context.fillRect(left, top, Math.max(place.x(edges[n + 1]) - left - 1, 1), place.bottom - top);
  });
}

function barRows(bars, { labels = {} }) {
  if (!bars) return [];
  const { edges, counts } = bars;
  return counts.map((count, n) => {
    const middle = (edges[n] + edges[n + 1]) / 2;
    const value = labels[middle] ?? `${numberText(edges[n])} – ${numberText(edges[n + 1])}`;
    return el("tr", {}, el("th", { scope: "row" }, value), el("td", {}, count.toLocaleString("en")));
  });
}
