// Drawing on the canvas of a panel: colours, lines, bands of envelopes, gaps.

import { firstIndexFrom } from "./series.js";

const COLOUR_COUNT = 8;
const COLOUR_VARIABLES = { ink: "--ink", ink2: "--ink-2", line: "--line", surface: "--surface", accent: "--accent",
  shade: "--shade", error: "--error", errorBg: "--error-bg", staleBg: "--stale-bg" };

/**
 * Read the colours that canvases draw with.
 * @param {HTMLElement} root
 * @returns {Record<string, string> & {plot: string[]}}
 */
export function readColours(root) {
  const probe = document.createElement("span");
  probe.hidden = true;
  if (isPrinting) probe.style.colorScheme = "light"; // paper is
  root.append(probe);
  const read = (name) => {
    probe.style.color = `var(${name})`;
    return getComputedStyle(probe).color;
  };
  const found = Object.fromEntries(Object.entries(COLOUR_VARIABLES).map(([key, name]) => [key, read(name)]));
  found.plot = Array.from({ length: COLOUR_COUNT }, (_, n) => read(`--plot-${n + 1}`));
  probe.remove();
  return found;
}

let isPrinting = false;
addEventListener("beforeprint", () => { isPrinting = true; });
addEventListener("afterprint", () => { isPrinting = false; });

/** Call `fn` when the theme changes; also before (it has to draw at once) and after printing. @param {function(): void} fn */
export function onThemeChange(fn, signal) {
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  dark.addEventListener("change", fn, { signal });
  const watcher = new MutationObserver(fn);
  watcher.observe(document.documentElement, { attributeFilter: ["data-theme"] });
  signal.addEventListener("abort", () => watcher.disconnect());
  for (const event of ["beforeprint", "afterprint"]) addEventListener(event, fn, { signal });
}

/**
 * A `Frame` tells where values lie on the canvas; all lengths are pixels of the canvas.
 *
 * @typedef {object} Frame
 * @property {CanvasRenderingContext2D} context
 * @property {number} left @property {number} top @property {number} width @property {number} height
 * @property {number} from @property {number} to seconds at the left and the right edge
 * @property {number} low @property {number} high values at the lower and the upper edge
 * @property {number} dpr pixels of the canvas per pixel of the page
 */

const DOTS_EVERY_PX = 9;
const DASH = [5, 4];

/** @param {Frame} frame */
const xOf = (frame, time) =>
  frame.left + ((time - frame.from) / (frame.to - frame.from)) * frame.width;

/** @param {Frame} frame */
const yOf = (frame, value) =>
  frame.top + (1 - (value - frame.low) / (frame.high - frame.low)) * frame.height;

/**
 * Draw a variable.
 * @param {Frame} frame
 * @param {import("./series.js").Series} series
 * @param {{colour: string, steps: boolean, breaks: {from: number, to: number}[], strong: boolean,
 *   sure: ?{from: number, to: number}}} style `sure` is the time of which all gaps are known
 */
export function drawSeries(frame, series, style) {
  const { context, dpr } = frame;
  context.save();
  context.beginPath();
  context.rect(frame.left, frame.top, frame.width, frame.height);
  context.clip();
  context.strokeStyle = context.fillStyle = style.colour;
  context.lineWidth = (style.strong ? 2.6 : 1.4) * dpr;
  context.lineJoin = "round";
  const [first, end] = visibleRange(frame, series);
  if (series.envelope) drawBand(frame, series, first, end);
  if (!(series.envelope && style.steps)) drawLine(frame, series, style, first, end);
  if (!series.envelope) drawDots(frame, series, first, end);
  context.restore();
}

/** Draw the line of a mark over the whole height. @param {Frame} frame */
export function drawMarkLine(frame, time, colour) {
  const x = Math.round(xOf(frame, time)) + 0.5;
  if (x < frame.left || x > frame.left + frame.width) return;
  const { context } = frame;
  context.save();
  context.strokeStyle = colour;
  context.lineWidth = frame.dpr;
  context.setLineDash([2 * frame.dpr, 3 * frame.dpr]);
  context.beginPath();
  context.moveTo(x, frame.top);
  context.lineTo(x, frame.top + frame.height);
  context.stroke();
  context.restore();
}

/** Return the range of visible rows, and one more at each side. */
function visibleRange(frame, { x }) {
  return [Math.max(firstIndexFrom(x, frame.from) - 1, 0), Math.min(firstIndexFrom(x, frame.to) + 1, x.length)];
}

/** Draw the band between least and greatest values, which contains the spike of a single row. */
function drawBand(frame, series, first, end) {
  const { context } = frame;
  const half = series.step / 2;
  for (const [start, stop] of connectedParts(series, first, end)) {
    context.beginPath();
    for (let n = start; n < stop; n++) {
      context.lineTo(xOf(frame, series.x[n] + half), yOf(frame, series.high[n]));
    }
    for (let n = stop - 1; n >= start; n--) {
      context.lineTo(xOf(frame, series.x[n] + half), yOf(frame, series.low[n]));
    }
    context.closePath();
    context.globalAlpha = 0.28;
    context.fill();
    context.globalAlpha = 0.6;
    context.save();
    context.lineWidth = frame.dpr;
    context.stroke();
    context.restore();
    context.globalAlpha = 1;
  }
}

/** Yield the parts of a series between silences. */
function* connectedParts(series, first, end) {
  let start = -1;
  for (let n = first; n <= end; n++) {
    const there = n < end && !Number.isNaN(series.low[n]);
    const far = start >= 0 && n < end && series.x[n] - series.x[n - 1] > series.silence;
    if (start >= 0 && (!there || far)) yield [start, n];
    if (!there) start = -1;
    else if (start < 0 || far) start = n;
  }
}

function drawLine(frame, series, style, first, end) {
  const solid = new Path2D();
  const held = new Path2D();
  let last = -1;
  for (let n = first; n < end; n++) {
    if (Number.isNaN(series.mean[n])) {
      last = -1;
      continue;
    }
    extendLine(frame, series, style, solid, held, last, n);
    last = n;
  }
  frame.context.stroke(solid);
  frame.context.setLineDash(DASH.map((px) => px * frame.dpr));
  frame.context.stroke(held);
  frame.context.setLineDash([]);
}

/** Extend a line to the next row: straight, in a step, held over silence, or interrupted. */
function extendLine(frame, series, style, solid, held, last, n) {
  const half = series.step / 2;
  const x = xOf(frame, series.x[n] + half);
  const y = yOf(frame, series.mean[n]);
  const isSilent = last >= 0 && series.x[n] - series.x[last] > series.silence;
  if (last < 0 || isInGap(style.breaks, series.x[last], series.x[n])
      || (isSilent && !isKnownComplete(frame, style.sure, series.x[last], series.x[n]))) {
    solid.moveTo(x, y);
    return;
  }
  const before = yOf(frame, series.mean[last]);
  if (isSilent) {
    held.moveTo(xOf(frame, series.x[last] + half), before);
    held.lineTo(x, before);
    solid.moveTo(x, before);
  } else if (style.steps) {
    solid.lineTo(x, before);
  }
  solid.lineTo(x, y);
}

/** Tell whether a gap lies between two times. */
function isInGap(breaks, from, to) {
  return breaks.some((gap) => gap.from < to && gap.to > from);
}

/** Tell whether all gaps are known in the visible part between two times. */
function isKnownComplete(frame, sure, from, to) {
  return sure !== null && Math.max(from, frame.from) >= sure.from && Math.min(to, frame.to) <= sure.to;
}

/** Draw each row as a dot, if they are far enough apart. */
function drawDots(frame, series, first, end) {
  const room = frame.width / frame.dpr / DOTS_EVERY_PX;
  if (end - first > room) return;
  const { context } = frame;
  const radius = 2.2 * frame.dpr;
  context.beginPath();
  for (let n = first; n < end; n++) {
    if (Number.isNaN(series.low[n])) continue;
    const x = xOf(frame, series.x[n]);
    const y = yOf(frame, series.low[n]);
    context.moveTo(x + radius, y);
    context.arc(x, y, radius, 0, 2 * Math.PI);
  }
  context.fill();
}

const TILE_PX = 8;
const CAP_PX = 4;
const LEAST_PX = 3;
const LEAST_CAP_PX = 7;

/**
 * How kinds of gaps are hatched, as `.plot-hatch-…` of the style sheet: lines as x1, y1, x2, y2 of a
 * tile, or dots as x, y; ink and ground are colours of the page. Only gaps that matter have a ground.
 */
const HATCHES = {
  filtered: { lines: [[0, 4, 8, 4]], ink: "ink2" },
  lost: { lines: [[0, 8, 8, 0]], ink: "ink2", ground: "errorBg" },
  refused: { lines: [[0, 8, 8, 0]], ink: "error", ground: "errorBg", width: 2.4 },
  deleted: { lines: [[0, 8, 8, 0], [0, 0, 8, 8]], ink: "ink2", ground: "staleBg" },
  uncovered: { lines: [[0, 0, 8, 8]], ink: "ink2", ground: "shade" },
  waiting: { dots: [[2, 2], [6, 6]], ink: "accent", ground: "shade" },
  to_come: { dots: [[2, 2], [6, 6]], ink: "ink2", ground: "shade" },
};

/**
 * Hatch a gap over the whole height; a line at both ends and a cap at the top tell it from the grid.
 * @param {import("./draw.js").Frame} frame @param {import("./series.js").Gap} gap
 * @param {{colours: any, own: string, patterns: Map<string, CanvasPattern>}} style `own` is the
 *   colour of its variable, where several have their own gaps
 */
export function drawGap(frame, { from, to, kind }, style) {
  const { context, dpr } = frame;
  const [left, right] = [Math.max(xOf(frame, from), frame.left), Math.min(xOf(frame, to), frame.left + frame.width)];
  if (right <= frame.left || left >= frame.left + frame.width) return;
  const hatch = HATCHES[kind];
  const ink = style.own || style.colours[hatch.ink];
  const width = Math.max(right - left, LEAST_PX * dpr);
  context.save();
  if (hatch.ground && !style.own) fillBox(context, style.colours[hatch.ground], 1, left, frame.top, width, frame.height);
  fillBox(context, hatchPattern(context, kind, ink, dpr, style.patterns), 1, left, frame.top, width, frame.height);
  if (hatch.ground) drawGapEdges(frame, ink, left, width);
  context.restore();
}

/** Draw the lines at both ends and the cap. */
function drawGapEdges({ context, top, height, dpr }, ink, left, width) {
  for (const x of [left, left + width - dpr]) fillBox(context, ink, 0.6, x, top, dpr, height);
  const cap = Math.max(width, LEAST_CAP_PX * dpr);
  fillBox(context, ink, 0.75, left - (cap - width) / 2, top, cap, CAP_PX * dpr);
}

function fillBox(context, style, alpha, ...box) {
  context.globalAlpha = alpha;
  context.fillStyle = style;
  context.fillRect(...box);
}

/** Return a pattern of hatching, from a cache. */
function hatchPattern(context, kind, ink, dpr, known) {
  const key = `${kind} ${ink} ${dpr}`;
  if (!known.has(key)) known.set(key, context.createPattern(hatchTile(HATCHES[kind], ink, dpr), "repeat"));
  return known.get(key);
}

function hatchTile({ lines = [], dots = [], width = 1.2 }, ink, dpr) {
  const tile = document.createElement("canvas");
  tile.width = tile.height = TILE_PX * Math.max(1, Math.round(dpr));
  const pen = tile.getContext("2d");
  pen.scale(tile.width / TILE_PX, tile.height / TILE_PX);
  pen.strokeStyle = pen.fillStyle = ink;
  pen.globalAlpha = 0.5;
  pen.lineWidth = width;
  pen.beginPath();
  for (const [x1, y1, x2, y2] of lines) {
    pen.moveTo(x1, y1);
    pen.lineTo(x2, y2);
  }
  pen.stroke();
  for (const [x, y] of dots) pen.fillRect(x - 0.75, y - 0.75, 1.5, 1.5);
  return tile;
}
