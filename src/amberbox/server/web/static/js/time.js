// Times: written for the viewer, kept current on the page, read from fields and addresses.
// Ages are counted from the server's time of the page by a monotonic clock, never the viewer's clock.

import { findAll, setText, setTextAttribute } from "./dom.js";
import { t } from "./strings.js";

/** Units of durations with their seconds, the longest first. */
export const UNITS = [["d", 86400], ["h", 3600], ["min", 60], ["s", 1]];

const SUFFIX_S = { ns: 1e-9, us: 1e-6, ms: 1e-3, s: 1, m: 60, min: 60, h: 3600, d: 86400 };
const OFFSET_PART = /(\d+(?:\.\d+)?)(ns|us|ms|min|s|m|h|d)/g;
// an epoch below the limit is in seconds, milliseconds, microseconds, nanoseconds
const EPOCH_UNITS = [[1e11, 1], [1e14, 1e3], [1e17, 1e6], [Infinity, 1e9]];
const FORMATS = {
  time: new Intl.DateTimeFormat(undefined, { hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23" }),
  date: new Intl.DateTimeFormat(undefined, { day: "numeric", month: "short", year: "numeric" }),
  at: new Intl.DateTimeFormat(undefined, {
    day: "numeric", month: "short", hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23",
  }),
};

// the page holds the time when it was rendered, which was when its first byte came
const pageStartMs = performance.getEntriesByType("navigation")[0]?.responseStart || performance.now();
const serverMs = Date.parse(document.querySelector('meta[name="now"]')?.content ?? "") || Date.now();

/** Return the server's time now, in ms since the epoch. */
export const nowMs = () => serverMs + performance.now() - pageStartMs;

// ---- for the viewer

/** Return a time in the viewer's zone. @param {number} ms @param {"at"|"time"|"date"} as */
export const localTime = (ms, as = "at") => FORMATS[as].format(ms);

/** Return a time in UTC, with milliseconds. @param {number} ms */
export const utcText = (ms) => t("common.shown_utc", { text: new Date(ms).toISOString().replace("T", " ").slice(0, 23) });

/** Return a duration in one unit: "5 min". @param {number} seconds */
export function durationText(seconds) {
  const [unit, n] = inUnit(Math.max(0, Math.floor(seconds)));
  return t(`common.span.${unit}`, { n });
}

/** Return how long ago a time is. @param {number} ms */
function agoText(ms) {
  const seconds = (nowMs() - ms) / 1000;
  if (Math.abs(seconds) < 1.5) return t("common.ago.now");
  if (seconds < 0) return t("common.ago.ahead", { text: durationText(-seconds) });
  const [unit, n] = inUnit(seconds);
  return t(`common.ago.${unit}`, { n });
}

/** Return the largest unit that fits into a duration, and how often. */
function inUnit(seconds) {
  const [unit, size] = UNITS.find(([, size]) => seconds >= size) ?? ["s", 1];
  return [unit, Math.floor(seconds / size)];
}

/** Make an element that shows a time and stays current. @param {string} stamp @param {string} as */
export function timeElement(stamp, as = "at") {
  const element = document.createElement("time");
  element.dateTime = stamp;
  element.dataset.as = as;
  writeTime(element);
  return element;
}

/** Write all times below an element. */
export function updateTimes(root = document) {
  for (const element of findAll("time[data-as]", root)) writeTime(element);
}

function writeTime(element) {
  const ms = Date.parse(element.dateTime);
  if (Number.isNaN(ms)) return;
  const as = element.dataset.as;
  const isAge = as === "ago" || as === "span";
  setText(element, as === "ago" ? agoText(ms) : as === "span" ? durationText((nowMs() - ms) / 1000) : localTime(ms, as));
  setTextAttribute(element, "title", isAge ? `${localTime(ms)} · ${utcText(ms)}` : utcText(ms));
}

setInterval(() => findAll('time[data-as="ago"], time[data-as="span"]').forEach(writeTime), 1000);

// ---- for the API (RFC 3339) and for fields of the type datetime-local

/** Write a time as RFC 3339. @param {number} ms */
export const msToStamp = (ms) => new Date(ms).toISOString();

/** Write a time as RFC 3339. @param {number} time seconds since 1970 */
export const secondsToStamp = (time) => msToStamp(Math.round(time * 1000));

/** Write a time for a field, in the viewer's zone. @param {number} ms */
export function msToField(ms) {
  if (Number.isNaN(ms)) return "";
  return new Date(ms - new Date(ms).getTimezoneOffset() * 60_000).toISOString().slice(0, 19);
}

/** Read a field as RFC 3339; "" for an empty one. @param {string} text */
export const fieldToStamp = (text) => (text ? msToStamp(Date.parse(text)) : "");

/** Read a field as seconds; null for an empty one. @param {string} text */
export function fieldToSeconds(text) {
  const ms = new Date(text).getTime();
  return Number.isNaN(ms) ? null : ms / 1000;
}

/** Read RFC 3339 with up to nanoseconds as seconds; null for none. @param {?string} text */
export function stampToSeconds(text) {
  if (!text) return null;
  const fraction = /\.(\d+)/.exec(text);
  const whole = Date.parse(text.replace(/\.\d+/, "")) / 1000;
  return whole + (fraction ? Number(`0.${fraction[1]}`) : 0);
}

/** Write seconds as a parameter of a query, to the microsecond. @param {number} time */
export const secondsParam = (time) => time.toFixed(6);

/**
 * Read a time of an address: RFC 3339 (without a zone UTC), an epoch, `now`, `now-1h`, or `-10m`
 * before the last record; null if it is none of these. All times are seconds since 1970.
 * @param {string} text @param {{now: number, last: ?number}} reference
 */
export function parseTime(text, { now, last }) {
  const trimmed = text.trim();
  const relative = /^(now|)([+-].+)?$/.exec(trimmed);
  if (trimmed && relative) return shiftTime(relative[1] ? now : last, relative[2]);
  if (/^\d+(\.\d+)?$/.test(trimmed)) return Number(trimmed) / EPOCH_UNITS.find(([limit]) => Number(trimmed) < limit)[1];
  const zoned = /(Z|[+-]\d\d:?\d\d)$/i.test(trimmed) ? trimmed : `${trimmed}Z`;
  const found = stampToSeconds(/^\d{4}-\d\d-\d\d[T ]/.test(trimmed) ? zoned.replace(" ", "T") : trimmed);
  return Number.isNaN(found) ? null : found;
}

function shiftTime(from, by) {
  if (from === null || !by) return from;
  const parts = [...by.slice(1).matchAll(OFFSET_PART)];
  if (parts.map(([whole]) => whole).join("") !== by.slice(1)) return null;
  const length = parts.reduce((sum, [, number, unit]) => sum + Number(number) * SUFFIX_S[unit], 0);
  return by[0] === "-" ? from - length : from + length;
}

/** Return a function that calls `fn` with the last arguments once the calls have paused for `ms`. */
export function debounce(fn, ms) {
  let timer = 0;
  return (...args) => {
    clearTimeout(timer);
    timer = setTimeout(fn, ms, ...args);
  };
}
