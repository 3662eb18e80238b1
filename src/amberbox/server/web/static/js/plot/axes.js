// Axes of plots: labels of times and numbers.

import { escapeHidden } from "../dom.js";

const DAY_S = 86400;
const CHAR_0 = 48;

/** @param {Intl.DateTimeFormatOptions} options */
const format = (options) => new Intl.DateTimeFormat("en-GB", options);
const MINUTES = format({ hour: "2-digit", minute: "2-digit" });
const SECONDS = format({ hour: "2-digit", minute: "2-digit", second: "2-digit" });
const DATE = format({ day: "numeric", month: "short", year: "numeric" });
const SHORT_DATE = format({ day: "numeric", month: "short" });

/** Return a time of day, such as 14:03:20.5. @param {number} time @param {number} step seconds */
function timeOfDay(time, step) {
  if (step >= 60) return MINUTES.format(new Date(Math.round(time) * 1000));
  const digits = digitsOf(step);
  const [whole, part] = splitSeconds(time, digits);
  return SECONDS.format(new Date(whole * 1000)) + part;
}

/** Return the labels of an axis; the date stands below the first one and where the day changes. */
function clockLabels(times, step) {
  let last = "";
  return times.map((time) => {
    const date = new Date(time * 1000);
    const day = SHORT_DATE.format(date);
    const full = last ? day : DATE.format(date);
    const changed = day !== last;
    last = day;
    if (step >= DAY_S) return full;
    return changed ? `${timeOfDay(time, step)}\n${full}` : timeOfDay(time, step);
  });
}

/** Return date and time. @param {number} time @param {number} step seconds that matter */
export function dateTime(time, step) {
  return `${DATE.format(new Date(time * 1000))}, ${timeOfDay(time, Math.min(step, 1))}`;
}

/** Return the time since a beginning, such as 1:03:20.5. */
export function elapsed(time, step) {
  const [whole, part] = splitSeconds(Math.abs(time), digitsOf(step));
  const two = (n) => String.fromCharCode(CHAR_0 + Math.floor(n / 10), CHAR_0 + (n % 10));
  const hours = Math.floor(whole / 3600);
  const rest = `${two(Math.floor(whole / 60) % 60)}:${two(whole % 60)}${part}`;
  return `${time < 0 ? "−" : ""}${hours ? `${hours}:` : ""}${rest}`;
}

/** Return the decimals of seconds that a step needs, up to microseconds. */
function digitsOf(step) {
  return step >= 1 ? 0 : Math.min(6, Math.ceil(-Math.log10(step) - 1e-9));
}

/** Split into whole seconds and their fraction as text. */
function splitSeconds(time, digits) {
  const scale = 10 ** digits;
  const rounded = Math.round(time * scale);
  const whole = Math.floor(rounded / scale);
  if (!digits) return [whole, ""];
  return [whole, `.${String(rounded - whole * scale).padStart(digits, "0")}`];
}

// lengths are for a page whose font is 16 px, and grow with it, as on wall screens
const SCALE = Math.max(1, parseFloat(getComputedStyle(document.documentElement).fontSize) / 16);
/** Return a length on a canvas in pixels. @param {number} length at a font of 16 px */
export const scaled = (length) => Math.round(length * SCALE);
const AXIS_WIDTH = scaled(76);
const NARROW_AXIS_WIDTH = scaled(56);
export const TIME_HEIGHT = scaled(44);
const LABEL_SIZE = scaled(16);
export const FONT = `${scaled(12)}px system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif`;
const SINCE_STEPS = [
  1e-6, 1e-5, 1e-4, 1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60,
  120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800, 86400, 172800, 604800,
];

/**
 * Return the axis of time below a panel, in the viewer's zone.
 * @param {{relative: boolean, ink: function(): string, line: function(): string, hasLabels: boolean}} options
 */
export function timeAxis({ relative, ink, line, hasLabels }) {
  const values = (_, times, __, ___, step) =>
    relative ? times.map((time) => elapsed(time, step)) : clockLabels(times, step);
  return {
    scale: "x", side: 2, size: hasLabels ? TIME_HEIGHT : 8, space: scaled(relative ? 70 : 84), font: FONT,
    gap: 9, stroke: ink, grid: { stroke: line, width: 1 }, ticks: { show: false },
    values: hasLabels ? values : (_, times) => times.map(() => ""),
    ...(relative ? { incrs: SINCE_STEPS } : {}),
  };
}

/**
 * Return an axis of values: numbers with their unit, or names.
 * @param {{scale: string, unit: string, first: boolean, narrow: boolean, words: string[],
 *   ink: function(): string, line: function(): string}} options
 */
export function valueAxis({ scale, unit, first, narrow, words: names, ink, line }) {
  const common = {
    scale, side: first ? 3 : 1, font: FONT, stroke: ink, ticks: { show: false }, gap: 6,
    size: axisWidth(narrow) - (unit ? LABEL_SIZE : 0), grid: { show: first, stroke: line, width: 1 },
    label: escapeHidden(unit) || undefined, labelSize: LABEL_SIZE, labelFont: FONT, labelGap: 0,
  };
  if (!names.length) return { ...common, space: scaled(34), values: (_, v, __, ___, s) => axisNumbers(v, s) };
  const labels = shortenNames(names.map((word) => word && escapeHidden(word)), narrow ? 6 : 9);
  return {
    ...common,
    splits: () => names.map((_, n) => n).filter((n) => names[n] !== undefined),
    values: (_, places) => places.map((n) => labels[n] ?? ""),
  };
}

/** Return the width of an axis of values in pixels. */
export function axisWidth(narrow) {
  return narrow ? NARROW_AXIS_WIDTH : AXIS_WIDTH;
}

/** Write a number with up to six significant digits. @param {?number} value */
export function numberText(value) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  if (!Number.isFinite(value)) return value > 0 ? "∞" : "−∞";
  const size = Math.abs(value);
  if (size && (size >= 1e9 || size < 1e-4)) return withMinus(value.toExponential(3));
  return withMinus(String(Number(value.toPrecision(size >= 1e6 ? 9 : 6))));
}

/** Return the labels of an axis of numbers, with as many decimals as its step needs. */
function axisNumbers(values, step) {
  const size = Math.max(...values.map(Math.abs));
  if (size >= 1e6 || (size && size < 1e-4)) return values.map((v) => v && withMinus(v.toExponential(1)));
  const digits = decimals(step);
  return values.map((value) => withMinus(value.toFixed(digits)));
}

/** Return the decimals with which all multiples of a step can be written. */
function decimals(step) {
  let digits = 0;
  while (digits < 10 && Math.abs(step * 10 ** digits - Math.round(step * 10 ** digits)) > 1e-6) digits += 1;
  return digits;
}

function withMinus(text) {
  return text.replace("-", "−").replace("e+", "e");
}

/** Shorten names: first by the part with which all begin (`STATE_`), then at their end. */
function shortenNames(names, room) {
  if (names.every((text) => text.length <= room)) return names;
  const first = names.find(Boolean) ?? "";
  const ends = [...first.matchAll(/_/g)].map((match) => match.index + 1).reverse();
  const same = names.length > 1 ? ends.find((end) => names.every((text) => text.startsWith(first.slice(0, end)))) ?? 0 : 0;
  return names.map((text) => text.slice(same)).map((text) => (text.length > room ? `${text.slice(0, room - 1)}…` : text));
}
