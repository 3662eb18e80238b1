/** Axes of plots: time in the viewer's zone, numbers with their unit, names of values. */

import { visible } from "../dom.js";
import { clockLabels, since } from "./time.js";

const AXIS_WIDTH = 76;
const NARROW_AXIS_WIDTH = 56;
export const TIME_HEIGHT = 44;
const LABEL_SIZE = 16;
const FONT = "12px system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif";
const SINCE_STEPS = [
  1e-6, 1e-5, 1e-4, 1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60,
  120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800, 86400, 172800, 604800,
];

/**
 * The axis of time below a panel.
 * @param {{relative: boolean, ink: function(): string, line: function(): string, shown: boolean}} look
 */
export function timeAxis({ relative, ink, line, shown }) {
  const values = (_, times, __, ___, step) =>
    relative ? times.map((time) => since(time, step)) : clockLabels(times, step);
  return {
    scale: "x", side: 2, size: shown ? TIME_HEIGHT : 8, space: relative ? 70 : 84, font: FONT,
    gap: 9, stroke: ink, grid: { stroke: line, width: 1 }, ticks: { show: false },
    values: shown ? values : (_, times) => times.map(() => ""),
    ...(relative ? { incrs: SINCE_STEPS } : {}),
  };
}

/**
 * An axis of values.
 * @param {{scale: string, unit: string, first: boolean, narrow: boolean, words: string[],
 *   ink: function(): string, line: function(): string}} about
 */
export function valueAxis({ scale, unit, first, narrow, words, ink, line }) {
  const common = {
    scale, side: first ? 3 : 1, font: FONT, stroke: ink, ticks: { show: false }, gap: 6,
    size: axisWidth(narrow) - (unit ? LABEL_SIZE : 0), grid: { show: first, stroke: line, width: 1 },
    label: visible(unit) || undefined, labelSize: LABEL_SIZE, labelFont: FONT, labelGap: 0,
  };
  if (!words.length) return { ...common, space: 34, values: (_, v, __, ___, s) => numbers(v, s) };
  const shown = shortened(words.map((word) => word && visible(word)), narrow ? 6 : 9);
  return {
    ...common,
    splits: () => words.map((_, n) => n).filter((n) => words[n] !== undefined),
    values: (_, places) => places.map((n) => shown[n] ?? ""),
  };
}

/** Pixels that an axis of values takes. */
export function axisWidth(narrow) {
  return narrow ? NARROW_AXIS_WIDTH : AXIS_WIDTH;
}

/** Write a number for people: six digits, no more than it has. @param {?number} value */
export function plain(value) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  if (!Number.isFinite(value)) return value > 0 ? "∞" : "−∞";
  const size = Math.abs(value);
  if (size && (size >= 1e9 || size < 1e-4)) return minus(value.toExponential(3));
  return minus(String(Number(value.toPrecision(size >= 1e6 ? 9 : 6))));
}

/** Labels of an axis of numbers, with as many decimals as its step needs. */
function numbers(values, step) {
  const size = Math.max(...values.map(Math.abs));
  if (size >= 1e6 || (size && size < 1e-4)) return values.map((v) => v && minus(v.toExponential(1)));
  const digits = decimals(step);
  return values.map((value) => minus(value.toFixed(digits)));
}

/** Decimals that all multiples of a step can be written with. */
function decimals(step) {
  let digits = 0;
  while (digits < 10 && Math.abs(step * 10 ** digits - Math.round(step * 10 ** digits)) > 1e-6) digits += 1;
  return digits;
}

function minus(text) {
  return text.replace("-", "−").replace("e+", "e");
}

/** Cut words that have no room: first the part with which all begin (`STATE_`), then the end. */
function shortened(words, room) {
  if (words.every((text) => text.length <= room)) return words;
  const first = words.find(Boolean) ?? "";
  const ends = [...first.matchAll(/_/g)].map((match) => match.index + 1).reverse();
  const same = words.length > 1 ? ends.find((end) => words.every((text) => text.startsWith(first.slice(0, end)))) ?? 0 : 0;
  return words.map((text) => text.slice(same)).map((text) => (text.length > room ? `${text.slice(0, room - 1)}…` : text));
}
