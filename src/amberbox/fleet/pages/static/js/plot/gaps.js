/**
 * What is missing and why, sorted into five kinds that are hatched each in its own way.
 *
 * @typedef {{from: number, to: number, kind: string, reason: string}} Hole seconds
 */

import { seconds } from "./data.js";

/** The kinds, as the legend lists them. */
export const KINDS = ["filtered", "lost", "deleted", "uncovered", "to_come"];

/**
 * Keep the gaps of items as windows change: only what came is known. `lacking(traces, view)` are
 * the traces of which something is to be asked, `keep(trace, span, answer)` takes what came,
 * `of(trace)` gives what is known.
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
    of: (trace) => known.get(keyOf(trace))?.holes ?? [], forget: () => known.clear(),
  };
}

const keyOf = (trace) => `${trace.robot}\n${trace.item}\n${trace.origin}`;

/** Tell whether an answer that was cut was about nearly this window. */
function isNear(entry, view) {
  return entry.to - entry.from < 4 * (view.to - view.from);
}

function holeOf(gap, origin) {
  return { from: seconds(gap.from) - origin, to: seconds(gap.to) - origin, reason: gap.reason, kind: gap.kind };
}
