/** What is loaded beside the values of a window: gaps, sums, marks, lanes of states. */

import { ask } from "./ask.js";
import { asked } from "./plotdata.js";
import { loadLanes, loadMarks } from "./plotmarks.js";

const PAUSE_MS = 250;

/** @param {any} stack */
export function surroundings(stack) {
  const state = { watched: null, timer: 0, control: new AbortController(), isBusy: false };

  /**
   * Show what happened to a robot beside its values.
   * @param {?{robot: string, kinds?: string[], components?: ?string[]}} watched `kinds` of marks;
   *   `components` whose states are shown, [] for all, null for none
   */
  function watch(watched) {
    state.watched = watched;
    stack.marks = [];
    stack.lanes = [];
    want();
  }

  /** Ask, as soon as the window has stayed for a moment. */
  function want() {
    clearTimeout(state.timer);
    state.isBusy = true;
    state.timer = setTimeout(load, PAUSE_MS);
  }

  async function load() {
    state.control.abort();
    state.control = new AbortController();
    const { signal } = state.control;
    const traces = [...stack.traces.values()];
    const work = [stack.gaps.want(traces, stack.view), ...sums(traces, stack.view, signal), ...beside(signal)];
    await Promise.allSettled(work);
    if (signal.aborted) return;
    state.isBusy = false;
    stack.redraw();
  }

  function* beside(signal) {
    const { view, options } = stack;
    if (!state.watched || options.relative) return;
    const { robot, kinds = [], components = null } = state.watched;
    yield loadMarks(robot, kinds, view.from, view.to, signal).then((found) => {
      stack.marks = found;
    });
    if (components === null) return;
    yield loadLanes(robot, components, view.from, view.to, signal).then((found) => {
      stack.lanes = found;
    });
  }

  return { watch, want, isBusy: () => state.isBusy };
}

/** Ask for the sums of the window, of variables of one item together. */
function sums(traces, view, signal) {
  const groups = Map.groupBy(traces.filter((trace) => trace.kind !== "text"),
    (trace) => `${trace.robot}\n${trace.item}\n${trace.origin}`);
  return [...groups.values()].map((group) => sumsOf(group, view, signal));
}

async function sumsOf(group, { from, to }, signal) {
  const [{ robot, item, origin }] = group;
  const query = new URLSearchParams({ item, from: asked(Math.max(from + origin, 0)), to: asked(to + origin) });
  for (const trace of group) query.append("variables", trace.variable);
  const answer = await ask(`/api/v1/robots/${encodeURIComponent(robot)}/statistics?${query}`, { signal });
  group.forEach((trace, n) => {
    trace.sums = answer.variables[n] ? { ...answer.variables[n], exact: answer.exact } : null;
  });
}
