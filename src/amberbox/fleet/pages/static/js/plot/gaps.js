/**
 * What is missing and why, sorted into kinds that are hatched each in its own way.
 *
 * @typedef {{from: number, to: number, kind: string, reason: string}} Hole seconds
 */

import { seconds } from "./data.js";
import { t } from "../strings.js";

/** The kinds, as the legend lists them. */
export const KINDS = ["filtered", "lost", "refused", "deleted", "uncovered", "waiting", "to_come"];

/** Kinds that come to an end later than what the server has looked at. */
const HERE = new Set(["refused", "waiting"]);
const EDGE_S = 1;

/**
 * Keep the gaps of items as windows change: only what came is known. `lacking(traces, view)` are
 * the traces of which something is to be asked, `keep(trace, span, answer)` takes what came,
 * `of(trace)` gives what is known, `reach(trace)` from when to when it is known, null for never.
 */
export function gapKeeper() {
  /** @type {Map<string, {from: number, to: number, whole: boolean, holes: Hole[]}>} */
  const known = new Map();

  function isKnown(trace, view) {
    const entry = known.get(keyOf(trace));
    return entry && entry.from <= view.from && entry.to >= view.to && (entry.whole || isNear(entry, view));
  }

  /** @param {{from: number, to: number}} span by the clock of the robot */
  function keep(trace, { from, to }, { gaps, more }) {
    known.set(keyOf(trace), {
      from: from - trace.origin, to: to - trace.origin, whole: !more,
      holes: gaps.map((gap) => holeOf(gap, trace.origin)),
    });
  }

  return {
    keep, lacking: (traces, view) => traces.filter((trace) => !isKnown(trace, view)),
    of: (trace) => known.get(keyOf(trace))?.holes ?? [], reach: (trace) => known.get(keyOf(trace)) ?? null,
    forget: () => known.clear(),
  };
}

/**
 * What is missing of a variable up to the end of a window: what is known, and what is to come behind
 * the last time of which the server has everything. A mission's end with it.
 * @param {any} trace @param {Hole[]} known @param {number} to
 * @returns {Hole[]}
 */
export function holesOf(trace, known, to) {
  const here = known.filter((one) => HERE.has(one.kind)).sort((one, other) => one.from - other.from);
  const from = here.reduce((since, one) => (one.from <= since + EDGE_S ? Math.max(since, one.to) : since),
    trace.series?.completeTo ?? Infinity);
  const behind = from < to ? [{ from, to, kind: "to_come", reason: t("plot.hole.to_come") }] : [];
  if (trace.length === null) return [...known, ...behind];
  return [...known, ...behind].map((one) => ({ ...one, from: Math.max(one.from, 0), to: Math.min(one.to, trace.length) }))
    .filter((one) => one.from < one.to);
}

/** The kind of the gap that covers a whole window; null where values may be. @param {Hole[]} holes */
export function kindOver(holes, { from, to }) {
  return holes.find((one) => one.from <= from && one.to >= to)?.kind ?? null;
}

const keyOf = (trace) => `${trace.robot}\n${trace.item}\n${trace.origin}`;

/** Tell whether an answer that was cut was about nearly this window. */
function isNear(entry, view) {
  return entry.to - entry.from < 4 * (view.to - view.from);
}

function holeOf(gap, origin) {
  return { from: seconds(gap.from) - origin, to: seconds(gap.to) - origin, reason: gap.reason, kind: gap.kind };
}
