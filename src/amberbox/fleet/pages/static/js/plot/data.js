/**
 * Numbers for plots: what the server sends (ABP1) in the form in which panels draw it.
 *
 * Times are seconds since 1970 as floating point numbers, good to a quarter of a microsecond.
 *
 * @typedef {object} Series
 * @property {Float64Array} x seconds; of an envelope the beginning of each step
 * @property {Float64Array} low least values, NaN where there is none
 * @property {Float64Array} high greatest values; the same array as `low` where every row is shown
 * @property {Float64Array} mean mean values; the same array where every row is shown
 * @property {boolean} envelope whether rows were summed up to steps
 * @property {number} step seconds that a step lasts; 0 where there are none
 * @property {number} of how many rows it was made of
 * @property {number} silence seconds without a row after which the value counts as held
 * @property {?number} completeTo up to when the server has everything, in seconds
 * @property {Float64Array} raw values as they came, before names took their place
 */

const MOST_WORDS = 200;

/** Read RFC 3339 with up to nanoseconds as seconds. @param {string} text */
export function seconds(text) {
  const fraction = /\.(\d+)/.exec(text);
  const whole = Date.parse(text.replace(/\.\d+/, "")) / 1000;
  return whole + (fraction ? Number(`0.${fraction[1]}`) : 0);
}

/** Write seconds as the server reads them in questions. @param {number} time */
export function asked(time) {
  return time.toFixed(6);
}

/** Read RFC 3339; nothing stays nothing. @param {?string} text */
export function maybeSeconds(text) {
  return text ? seconds(text) : null;
}

/**
 * Make a series of the answer about one variable.
 * @param {{header: any, columns: Float64Array[]}} answer as `askPlot` gives it
 * @returns {Series}
 */
export function seriesOf({ header: head, columns }) {
  const start = seconds(head.t0);
  const x = columns[0].map((after) => start + after);
  const about = { completeTo: maybeSeconds(head.complete_to) };
  if (head.kind !== "envelope") {
    const values = columns[1] ?? new Float64Array(0);
    return { x, low: values, high: values, mean: values, raw: values, envelope: false, step: 0, ...about,
      of: head.of ?? x.length, silence: silence(x, head.of ?? x.length) };
  }
  const [low, high, mean, count] = ["min", "max", "mean", "count"].map((state) =>
    columns[1 + head.columns.findIndex((column) => column.name.endsWith(`:${state}`))]);
  const step = least(x);
  return { x, low, high, mean, raw: mean, envelope: true, step, ...about,
    of: count.reduce((sum, n) => sum + n, 0), silence: 3 * step };
}

/**
 * Make a series of rows of texts: each text is the number of its place in `words`, which grows.
 * @param {any} answer rows as JSON @param {string[]} words those that are known
 * @returns {Series}
 */
export function wordsOf(answer, words) {
  const at = answer.columns.findIndex((column) => column.type !== "time");
  const texts = answer.data.map((row) => (row[at] === null ? null : String(row[at])));
  for (const text of new Set(texts)) {
    if (text !== null && !words.includes(text) && words.length < MOST_WORDS) words.push(text);
  }
  const numbers = new Map(words.map((word, n) => [word, n]));
  const x = Float64Array.from(answer.data, (row) => seconds(row[0]));
  const values = Float64Array.from(texts, (text) => numbers.get(text) ?? NaN);
  return { x, low: values, high: values, mean: values, raw: values, envelope: false, step: 0,
    of: answer.of ?? x.length, silence: silence(x, x.length),
    completeTo: maybeSeconds(answer.complete_to) };
}

/**
 * Put named values at equal distances: each becomes the place of its name. Values between names
 * lie between them.
 * @param {Series} series @param {number[]} codes the named values, in order
 * @returns {Series}
 */
export function placed(series, codes) {
  const lines = [series.low, series.high].map((line) => line.map((value) => placeOf(codes, value)));
  const [low, high] = series.envelope ? lines : [lines[0], lines[0]];
  return { ...series, low, high, mean: low };
}

/** Where a value stands among named ones. */
export function placeOf(codes, value) {
  if (Number.isNaN(value)) return NaN;
  const next = firstFrom(codes, value);
  return codes[next] === value ? next : next - 0.5;
}

/** Move a series in time. @param {Series} series @param {number} by seconds @returns {Series} */
export function moved(series, by) {
  if (!by) return series;
  const completeTo = series.completeTo === null ? null : series.completeTo + by;
  return { ...series, x: series.x.map((time) => time + by), completeTo };
}

/** The first place in `x` that is not before a time. @param {Float64Array|number[]} x */
export function firstFrom(x, time) {
  let low = 0;
  let high = x.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (x[middle] < time) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** The place of the row that counts at a time: the last one up to it, -1 for none. */
export function placeAt(series, time) {
  const place = firstFrom(series.x, time);
  return place < series.x.length && series.x[place] === time ? place : place - 1;
}

/** Least and greatest value within a range, else of what holds there; null without any. */
export function extremes(series, from, to) {
  const found = between(series, firstFrom(series.x, from - series.step), firstFrom(series.x, to));
  if (found) return found;
  const place = placeAt(series, from);
  return place < 0 ? null : between(series, place, place + 1);
}

function between(series, start, end) {
  let low = Infinity;
  let high = -Infinity;
  for (let n = start; n < end; n++) {
    if (series.low[n] < low) low = series.low[n];
    if (series.high[n] > high) high = series.high[n];
  }
  return low <= high ? [low, high] : null;
}

/**
 * Put rows of an older answer before and behind, so that lines reach the edges of the window.
 * Only of one that has every row of its range.
 */
export function withNeighbours(series, older, from, to) {
  if (!older || series.envelope || older.envelope || older.of > older.x.length) return series;
  const before = placeAt(older, from);
  const behind = firstFrom(older.x, to);
  const head = before >= 0 && !(series.x[0] <= from) ? [before] : [];
  const last = series.x[series.x.length - 1];
  const tail = behind < older.x.length && !(last >= to) ? [behind] : [];
  if (!head.length && !tail.length) return series;
  const joined = (mine, theirs) =>
    Float64Array.from([...head.map((n) => theirs[n]), ...mine, ...tail.map((n) => theirs[n])]);
  const values = joined(series.low, older.low);
  return { ...series, x: joined(series.x, older.x), low: values, high: values, mean: values,
    raw: joined(series.raw, older.raw) };
}

/** How long a row's value holds without another: ten usual distances, at least a second. */
function silence(x, of) {
  if (x.length < 2) return 1;
  const distances = x.slice(1).map((time, n) => time - x[n]).sort();
  const usual = distances[distances.length >> 1];
  const thinned = of > x.length ? (12 * (x[x.length - 1] - x[0])) / x.length : 0;
  return Math.max(1, 10 * usual, thinned);
}

/** The least distance between neighbours. */
function least(x) {
  let found = Infinity;
  for (let n = 1; n < x.length; n++) found = Math.min(found, x[n] - x[n - 1]);
  return Number.isFinite(found) ? found : 1;
}
