/**
 * What is missing and why, sorted into five kinds that are hatched each in its own way.
 *
 * @typedef {{from: number, to: number, kind: string, reason: string}} Hole seconds
 */

import { ask } from "./ask.js";
import { asked, seconds } from "./plotdata.js";

/** The kinds, as the legend lists them. */
export const KINDS = ["filtered", "lost", "deleted", "uncovered", "tocome"];
const WORDS = [
  ["tocome", /not on the server yet|its columns are to come/i],
  ["deleted", /^deleted/i],
  ["filtered", /filter|unchanged|rate.?limit/i],
  ["lost", /lost|dropped|queue|damaged|torn|refused|corrupt|decode|columns/i],
];
const LIMIT = 1000;
const AROUND = 0.5;

/** Sort a reason into its kind. @param {string} reason */
export function kindOf(reason) {
  return WORDS.find(([, words]) => words.test(reason))?.[0] ?? "uncovered";
}

/**
 * Ask for gaps of items as windows change; what was asked for a wider window is asked once.
 * `of(trace)` gives what is known, `want(traces, view)` asks, `changed` is called with news.
 * @param {function(): void} changed
 */
export function gapKeeper(changed) {
  /** @type {Map<string, {from: number, to: number, whole: boolean, holes: Hole[]}>} */
  const known = new Map();

  async function load(trace, { from, to }) {
    const around = AROUND * (to - from);
    const span = { from: from - around + trace.origin, to: to + around + trace.origin };
    const path = `/api/v1/robots/${encodeURIComponent(trace.robot)}/gaps`;
    const query = new URLSearchParams({
      item: trace.item, from: asked(Math.max(span.from, 0)), to: asked(span.to), limit: LIMIT,
    });
    const entry = { from: from - around, to: to + around, whole: true, holes: known.get(keyOf(trace))?.holes ?? [] };
    known.set(keyOf(trace), entry);
    const answer = await ask(`${path}?${query}`);
    entry.whole = !answer.more;
    entry.holes = answer.gaps.map((gap) => holeOf(gap, trace.origin));
    changed();
  }

  function want(traces, view) {
    const missing = new Map();
    for (const trace of traces) {
      const entry = known.get(keyOf(trace));
      const enough = entry && entry.from <= view.from && entry.to >= view.to
        && (entry.whole || isNear(entry, view));
      if (!enough) missing.set(keyOf(trace), trace);
    }
    return Promise.all([...missing.values()].map((trace) => load(trace, view)));
  }

  return { want, of: (trace) => known.get(keyOf(trace))?.holes ?? [], forget: () => known.clear() };
}

const keyOf = (trace) => `${trace.robot}\n${trace.item}\n${trace.origin}`;

/** Tell whether an answer that was cut was about nearly this window. */
function isNear(entry, view) {
  return entry.to - entry.from < 4 * (view.to - view.from);
}

function holeOf(gap, origin) {
  return { from: seconds(gap.from) - origin, to: seconds(gap.to) - origin, reason: gap.reason,
    kind: kindOf(gap.reason) };
}
