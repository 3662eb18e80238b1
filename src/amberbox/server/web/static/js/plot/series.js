// Values of plots: windows of time, series of numbers, gaps, and live values.

import { t } from "../strings.js";
import { stampToSeconds } from "../time.js";

/**
 * @typedef {{from: number, to: number}} Span a window of time, in seconds
 */

const LEAST_S = 1e-3;
const MOST_S = 100 * 366 * 86400;
const MOST_HISTORY = 50;

/** Zoom by a factor about a time that stays where it is. @param {Span} view @returns {Span} */
export function zoomed(view, factor, about = (view.from + view.to) / 2) {
  const part = (about - view.from) / (view.to - view.from);
  const width = boundedWidth((view.to - view.from) * factor);
  return { from: about - part * width, to: about + (1 - part) * width };
}

/** Move by a part of the window's width. @param {Span} view @param {number} part @returns {Span} */
export function panned(view, part) {
  const by = (view.to - view.from) * part;
  return { from: view.from + by, to: view.to + by };
}

/**
 * Return a window that is neither empty nor endless; one that is too wide keeps its end. Pages that
 * keep a window beside the plots bound it, too, so that both are equal.
 * @param {Span} view @returns {Span}
 */
export function boundedWindow({ from, to }) {
  const width = boundedWidth(to - from);
  if (width === to - from) return { from, to };
  if (width < to - from) return { from: to - width, to };
  const middle = (from + to) / 2;
  return { from: middle - width / 2, to: middle + width / 2 };
}

/** Add a window to the history. @param {Span[]} back @param {Span} view */
export function pushHistory(back, view) {
  back.push(view);
  if (back.length > MOST_HISTORY) back.shift();
}

/** @param {Span} one @param {Span} other */
export const isSameWindow = (one, other) => one.from === other.from && one.to === other.to;

function boundedWidth(width) {
  return Math.min(Math.max(width, LEAST_S), MOST_S);
}

/**
 * Times are seconds since 1970 as floating point numbers, exact to a quarter of a microsecond.
 *
 * @typedef {object} Series rows of a variable as panels draw them
 * @property {Float64Array} x seconds; of an envelope the beginning of each step
 * @property {Float64Array} low least values, NaN where there is none
 * @property {Float64Array} high greatest values; the same array as `low` where every row is shown
 * @property {Float64Array} mean mean values; the same array where every row is shown
 * @property {boolean} envelope whether rows were aggregated to steps
 * @property {number} step seconds that a step lasts; 0 where there are none
 * @property {number} of number of rows that it was made of
 * @property {number} silence seconds without a row after which the value counts as held
 * @property {?number} completeTo until when the server has everything, in seconds
 * @property {Float64Array} raw values as received, before they became places of names
 */

const MOST_TEXTS = 200;

/**
 * Make a series of the columns of one variable.
 * @param {{header: any, columns: Float64Array[]}} answer of `requestColumns`
 * @returns {Series}
 */
export function seriesOf({ header: header, columns }) {
  const start = stampToSeconds(header.t0);
  const x = columns[0].map((after) => start + after);
  const about = { completeTo: stampToSeconds(header.complete_to) };
  if (header.kind !== "envelope") {
    const values = columns[1] ?? new Float64Array(0);
    return { x, low: values, high: values, mean: values, raw: values, envelope: false, step: 0, ...about,
      of: header.of ?? x.length, silence: silenceOf(x, header.of ?? x.length) };
  }
  const [low, high, mean, count] = ["min", "max", "mean", "count"].map((state) =>
    columns[1 + header.columns.findIndex((column) => column.name.endsWith(`:${state}`))]);
  const step = leastStep(x);
  return { x, low, high, mean, raw: mean, envelope: true, step, ...about,
    of: count.reduce((sum, n) => sum + n, 0), silence: 3 * step };
}

/**
 * Make a series of rows of texts: each becomes its index in `known`, which grows.
 * @param {any} answer rows as JSON @param {string[]} known
 * @returns {Series}
 */
export function textSeriesOf(answer, known) {
  const at = answer.columns.findIndex((column) => column.type !== "time");
  const texts = answer.data.map((row) => (row[at] === null ? null : String(row[at])));
  for (const text of new Set(texts)) {
    if (text !== null && !known.includes(text) && known.length < MOST_TEXTS) known.push(text);
  }
  const numbers = new Map(known.map((word, n) => [word, n]));
  const x = Float64Array.from(answer.data, (row) => stampToSeconds(row[0]));
  const values = Float64Array.from(texts, (text) => numbers.get(text) ?? NaN);
  return { x, low: values, high: values, mean: values, raw: values, envelope: false, step: 0,
    of: answer.of ?? x.length, silence: silenceOf(x, x.length),
    completeTo: stampToSeconds(answer.complete_to) };
}

/**
 * Put named values at equal distances: each becomes the index of its name; others lie between.
 * @param {Series} series @param {number[]} codes the named values, in order
 * @returns {Series}
 */
export function toPlaces(series, codes) {
  const lines = [series.low, series.high].map((line) => line.map((value) => placeOf(codes, value)));
  const [low, high] = series.envelope ? lines : [lines[0], lines[0]];
  return { ...series, low, high, mean: low };
}

/** Return the index of a value among named ones. */
function placeOf(codes, value) {
  if (Number.isNaN(value)) return NaN;
  const next = firstIndexFrom(codes, value);
  return codes[next] === value ? next : next - 0.5;
}

/** Shift a series in time. @param {Series} series @param {number} by seconds @returns {Series} */
export function shifted(series, by) {
  if (!by) return series;
  const completeTo = series.completeTo === null ? null : series.completeTo + by;
  return { ...series, x: series.x.map((time) => time + by), completeTo };
}

/** Return the first index in `x` that is not before a time. @param {Float64Array|number[]} x */
export function firstIndexFrom(x, time) {
  let low = 0;
  let high = x.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (x[middle] < time) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** Return the index of the row at a time: the last one up to it, -1 for none. */
export function indexAt(series, time) {
  const place = firstIndexFrom(series.x, time);
  return place < series.x.length && series.x[place] === time ? place : place - 1;
}

/** Return least and greatest value in a range, else of the value held there; null without any. */
export function extremes(series, from, to) {
  const found = extremesBetween(series, firstIndexFrom(series.x, from - series.step), firstIndexFrom(series.x, to));
  if (found) return found;
  const place = indexAt(series, from);
  return place < 0 ? null : extremesBetween(series, place, place + 1);
}

function extremesBetween(series, start, end) {
  let low = Infinity;
  let high = -Infinity;
  for (let n = start; n < end; n++) {
    if (series.low[n] < low) low = series.low[n];
    if (series.high[n] > high) high = series.high[n];
  }
  return low <= high ? [low, high] : null;
}

/**
 * Add rows of an older series before and behind, so that lines reach the edges of the window; only
 * of one with every row of its range.
 */
export function withNeighbours(series, older, from, to) {
  if (!older || series.envelope || older.envelope || older.of > older.x.length) return series;
  const before = indexAt(older, from);
  const behind = firstIndexFrom(older.x, to);
  const header = before >= 0 && !(series.x[0] <= from) ? [before] : [];
  const last = series.x[series.x.length - 1];
  const tail = behind < older.x.length && !(last >= to) ? [behind] : [];
  if (!header.length && !tail.length) return series;
  const joined = (mine, theirs) =>
    Float64Array.from([...header.map((n) => theirs[n]), ...mine, ...tail.map((n) => theirs[n])]);
  const values = joined(series.low, older.low);
  return { ...series, x: joined(series.x, older.x), low: values, high: values, mean: values,
    raw: joined(series.raw, older.raw) };
}

/** Return how long the value of a row is held: ten median distances of rows, at least a second. */
function silenceOf(x, of) {
  if (x.length < 2) return 1;
  const distances = x.slice(1).map((time, n) => time - x[n]).sort();
  const usual = distances[distances.length >> 1];
  const thinned = of > x.length ? (12 * (x[x.length - 1] - x[0])) / x.length : 0;
  return Math.max(1, 10 * usual, thinned);
}

/** Return the least distance of neighbours. */
function leastStep(x) {
  let found = Infinity;
  for (let n = 1; n < x.length; n++) found = Math.min(found, x[n] - x[n - 1]);
  return Number.isFinite(found) ? found : 1;
}

const COLOUR_COUNT = 8;
const LEAST_PART_S = 1e-3;

/**
 * Return how a column is drawn.
 * @param {{type: string, labels: Record<string, string>}} column
 * @returns {"number"|"enum"|"bool"|"text"}
 */
export function kindOf(column) {
  if (Object.keys(column.labels ?? {}).length) return "enum";
  if (column.type === "bool") return "bool";
  return column.type === "string" ? "text" : "number";
}

/**
 * Make the trace of a variable, with a free colour (or that of the options) and the names of its values.
 * @param {import("./plot.js").TraceOptions} options @param {Set<number>} used colours that are taken
 * @returns {import("./panel.js").Trace}
 */
export function traceOf(options, used) {
  const { id, robot, item, variable, label = variable, unit = "", labels = {}, origin = 0, length = null, isArchived = true, request = null, colour = freeColour(used) } = options;
  const kind = options.kind ?? kindOf({ type: "", labels });
  const { codes, names } = namesOf(kind, labels);
  return {
    id, robot, item, variable, label, unit, kind, origin, length, isArchived, request, codes, names, panel: options.panel ?? id,
    colour, series: null, live: null, widest: null, statistics: null, problem: null, asked: null,
  };
}

/**
 * Return the part of a window in which a variable is shown: of a mission only its own time.
 * @param {{length: ?number}} trace @param {import("./series.js").Span} window
 * @returns {import("./series.js").Span}
 */
export function partInWindow({ length }, { from, to }) {
  if (length === null) return { from, to };
  const end = Math.min(Math.max(to, LEAST_PART_S), Math.max(length, LEAST_PART_S));
  return { from: Math.min(Math.max(from, 0), end - LEAST_PART_S), to: end };
}

/** Return the values that have names, in order, and the names. */
function namesOf(kind, labels) {
  if (kind === "bool") return { codes: [0, 1], names: [t("plot.no"), t("plot.yes")] };
  if (kind !== "enum") return { codes: [], names: [] };
  const codes = Object.keys(labels).map(Number).sort((one, other) => one - other);
  return { codes, names: codes.map((code) => labels[code]) };
}

function freeColour(used) {
  const free = Array.from({ length: COLOUR_COUNT }, (_, n) => n).find((n) => !used.has(n));
  return free ?? used.size % COLOUR_COUNT;
}

/**
 * @typedef {{from: number, to: number, kind: string, reason: string}} Gap seconds
 */

/** The kinds of gaps, as the legend lists them. */
export const GAP_KINDS = ["filtered", "lost", "refused", "deleted", "uncovered", "waiting", "to_come"];

// kinds of gaps up to which the server has everything
const ARRIVED_KINDS = new Set(["refused", "waiting"]);
const JOIN_S = 1;

/**
 * Cache the gaps of items as windows change. `lacking(traces, view)` returns the traces whose gaps
 * have to be loaded, `keep(trace, span, answer)` stores an answer, `of(trace)` returns known gaps,
 * `reach(trace)` the time of which they are known, or null.
 */
export function gapCache() {
  /** @type {Map<string, {from: number, to: number, whole: boolean, gaps: Gap[]}>} */
  const known = new Map();

  function isKnown(trace, view) {
    const entry = known.get(gapKey(trace));
    return entry && entry.from <= view.from && entry.to >= view.to && (entry.whole || isNear(entry, view));
  }

  /** @param {{from: number, to: number}} span by the clock of the robot */
  function keep(trace, { from, to }, { gaps, more }) {
    known.set(gapKey(trace), {
      from: from - trace.origin, to: to - trace.origin, whole: !more,
      gaps: gaps.map((gap) => gapOf(gap, trace.origin)),
    });
  }

  return {
    keep, lacking: (traces, view) => traces.filter((trace) => !isKnown(trace, view)),
    of: (trace) => known.get(gapKey(trace))?.gaps ?? [], reach: (trace) => known.get(gapKey(trace)) ?? null,
    forget: () => known.clear(),
  };
}

/**
 * Return the gaps of a variable up to a time: those that are known, and what is still to come. Gaps
 * of a mission end with it.
 * @param {any} trace @param {Gap[]} known @param {number} to
 * @returns {Gap[]}
 */
export function gapsUpTo(trace, known, to) {
  const arrived = known.filter((one) => ARRIVED_KINDS.has(one.kind)).sort((one, other) => one.from - other.from);
  const from = arrived.reduce((since, one) => (one.from <= since + JOIN_S ? Math.max(since, one.to) : since),
    trace.series?.completeTo ?? Infinity);
  const pending = from < to ? [{ from, to, kind: "to_come", reason: t("plot.hole.to_come") }] : [];
  if (trace.length === null) return [...known, ...pending];
  return [...known, ...pending].map((one) => ({ ...one, from: Math.max(one.from, 0), to: Math.min(one.to, trace.length) }))
    .filter((one) => one.from < one.to);
}

/** Return the kind of the gap that covers a whole window; null for none. @param {Gap[]} gaps */
export function gapKindOver(gaps, { from, to }) {
  return gaps.find((gap) => gap.from <= from && gap.to >= to)?.kind ?? null;
}

const gapKey = (trace) => `${trace.robot}\n${trace.item}\n${trace.origin}`;

/** Tell whether a truncated answer was about nearly this window. */
function isNear(entry, view) {
  return entry.to - entry.from < 4 * (view.to - view.from);
}

function gapOf(gap, origin) {
  return { from: stampToSeconds(gap.from) - origin, to: stampToSeconds(gap.to) - origin, reason: gap.reason, kind: gap.kind };
}

const MOST_LIVE = 20000;
const LIVE_SILENCE_S = 5;

/** Return the name of a variable in the feed. */
const liveName = (trace) => `${trace.item}.${trace.variable}`;

/** Return the request for the feed. @returns {Record<string, string[]>} robot -> variables */
export function liveRequest(traces) {
  const found = {};
  for (const trace of traces) {
    found[trace.robot] = [...new Set([...(found[trace.robot] ?? []), liveName(trace)])];
  }
  return found;
}

/** Append received values to their variables; returns the newest time, null for nothing new. */
export function appendLive(traces, robot, data) {
  let newest = null;
  for (const trace of traces) {
    const received = trace.robot === robot ? data[liveName(trace)] : undefined;
    if (!received?.at) continue;
    const time = stampToSeconds(received.at) - trace.origin;
    if (appendValue(trace, time, received.value)) newest = Math.max(newest ?? time, time);
  }
  return newest;
}

/** Drop live values that were loaded as rows meanwhile, and the oldest of too many. */
export function trimLive(trace) {
  if (!trace.live) return;
  const last = trace.series?.x[trace.series.x.length - 1] ?? -Infinity;
  const rows = rowsOf(trace.live).filter(([time]) => time > last).slice(-MOST_LIVE);
  trace.live = rows.length ? liveSeries(rows) : null;
}

function appendValue(trace, time, value) {
  const last = trace.live?.x[trace.live.x.length - 1] ?? -Infinity;
  if (time <= last) return false;
  const raw = numberOf(trace, value);
  const place = trace.codes.length ? placeOf(trace.codes, raw) : raw;
  const rows = trace.live ?? liveSeries([]);
  rows.x.push(time);
  rows.low.push(place);
  rows.raw.push(raw);
  trace.live = rows;
  return true;
}

function numberOf(trace, value) {
  if (trace.kind !== "text") return value === null ? NaN : Number(value);
  if (value === null) return NaN;
  const known = trace.names.indexOf(String(value));
  return known >= 0 ? known : trace.names.push(String(value)) - 1;
}

function rowsOf({ x, low, raw }) {
  return x.map((time, n) => [time, low[n], raw[n]]);
}

/** @returns {Series} */
function liveSeries(rows) {
  const low = rows.map((line) => line[1]);
  return { x: rows.map((line) => line[0]), low, high: low, mean: low, raw: rows.map((line) => line[2]),
    envelope: false, step: 0, of: rows.length, silence: LIVE_SILENCE_S, completeTo: null };
}
