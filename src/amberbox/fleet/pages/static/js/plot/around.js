/**
 * What is loaded beside the values of a window: gaps, marks and lanes of states by one question,
 * sums of each item by another. It waits for the values, which people look at first.
 */

import { ask } from "../ask.js";
import { asked } from "./data.js";
import { lanesOf, marksOf } from "./marks.js";
import { partOf } from "./trace.js";

const PAUSE_MS = 250;

/** @param {any} stack */
export function surroundings(stack) {
  const state = { robot: "", timer: 0, control: new AbortController(), isBusy: false, isUnsure: false };

  /** Show what happened to a robot beside its values, as it is now. @param {string} robot */
  function watch(robot) {
    if (robot !== state.robot) Object.assign(stack, { marks: [], lanes: [] });
    state.robot = robot;
    want();
  }

  /** Ask, as soon as the window has stayed for a moment. */
  function want() {
    clearTimeout(state.timer);
    state.isBusy = true;
    state.timer = setTimeout(load, PAUSE_MS);
  }

  async function load() {
    if (stack.end.aborted) return;
    if (stack.loader.isBusy()) {
      want();
      return;
    }
    state.control.abort();
    state.control = new AbortController();
    const { signal } = state.control;
    const traces = [...stack.traces.values()];
    await Promise.all([...beside(traces, signal), ...sums(traces, stack.view, signal)]);
    if (signal.aborted) return;
    state.isBusy = false;
    stack.redraw();
  }

  /** One question for each beginning that times are counted from: for one, if it is no comparison. */
  function* beside(traces, signal) {
    const withMarks = Boolean(state.robot) && !stack.options.relative;
    const lacking = stack.gaps.lacking(traces, stack.view);
    state.isUnsure &&= lacking.length > 0;
    const groups = [...Map.groupBy(lacking, (trace) => `${trace.robot}\n${trace.origin}`).values()];
    const isOwn = ([{ robot }]) => withMarks && robot === state.robot;
    for (const group of groups) yield around(group[0].robot, group, isOwn(group), signal);
    if (withMarks && !groups.some(isOwn)) yield around(state.robot, [], true, signal);
  }

  /** Ask; gaps that cannot be had now are asked for with the next window, and the legend says so. */
  async function around(robot, group, withMarks, signal) {
    const { view } = stack;
    const origin = group[0]?.origin ?? 0;
    const query = new URLSearchParams({ from: asked(Math.max(view.from + origin, 0)), to: asked(view.to + origin), marks: withMarks });
    for (const item of new Set(group.map((trace) => trace.item))) query.append("item", item);
    const found = await ask(`/robots/${encodeURIComponent(robot)}/data/around?${query}`, { signal }).catch(() => null);
    if (signal.aborted) return;
    if (group.length) state.isUnsure = !found?.gaps;
    for (const trace of found?.gaps ? group : []) stack.gaps.keep(trace, found.gaps, found.gaps.items[trace.item]);
    if (found && withMarks) Object.assign(stack, { marks: marksOf(found, view), lanes: lanesOf(found) });
  }

  return { watch, want, isBusy: () => state.isBusy, isUnsure: () => state.isUnsure };
}

/** Ask for the sums of the window, of variables of one item together. */
function sums(traces, view, signal) {
  const groups = Map.groupBy(traces.filter((trace) => trace.kind !== "text"),
    (trace) => `${trace.robot}\n${trace.item}\n${trace.origin}`);
  return [...groups.values()].map((group) => sumsOf(group, view, signal));
}

async function sumsOf(group, view, signal) {
  const [{ robot, item, origin }] = group;
  const { from, to } = partOf(group[0], view);
  const query = new URLSearchParams({ item, from: asked(Math.max(from + origin, 0)), to: asked(to + origin) });
  for (const trace of group) query.append("variables", trace.variable);
  const answer = await ask(`/api/v1/robots/${encodeURIComponent(robot)}/statistics?${query}`, { signal }).catch(() => null);
  if (signal.aborted) return;
  group.forEach((trace, n) => { // without an answer the table shows no sums, not those of before
    trace.sums = answer?.variables[n] ? { ...answer.variables[n], exact: answer.exact } : null;
  });
}
