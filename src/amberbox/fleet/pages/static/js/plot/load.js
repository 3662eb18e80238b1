/**
 * Loading what the window shows. Of each variable one question is under way; when the window has
 * moved on meanwhile, the newest is asked next. What is shown stays until its successor is there.
 */

import { ask, askPlot } from "../ask.js";
import { asked, moved, placed, seriesOf, withNeighbours, wordsOf } from "./data.js";
import { partOf } from "./trace.js";

const AT_ONCE = 4;
const PATIENCE_MS = 800;
const AROUND = 0.02;

/**
 * @param {{points: function(): number, loaded: function(any): void,
 *   failed: function(any, Error): void}} about
 */
export function loader({ points, loaded, failed }) {
  const jobs = new Map();
  const waiting = [];
  let busy = 0;

  /** Load a variable for a window. Stops an older question only if it takes long. */
  function load(trace, view) {
    const job = jobs.get(trace.id) ?? { trace, view: null, control: null, begun: 0 };
    jobs.set(trace.id, job);
    job.view = view;
    if (job.control && performance.now() - job.begun > PATIENCE_MS) job.control.abort();
    if (!job.control && !waiting.includes(job)) waiting.push(job);
    next();
  }

  function next() {
    while (busy < AT_ONCE && waiting.length) run(waiting.shift());
  }

  async function run(job) {
    const { trace, view } = job;
    job.view = null;
    job.control = new AbortController();
    job.begun = performance.now();
    busy += 1;
    try {
      await take(trace, view, points(), job.control.signal);
      if (jobs.get(trace.id) === job) loaded(trace);
    } catch (error) {
      if (error.name !== "AbortError" && jobs.get(trace.id) === job) failed(trace, error);
    } finally {
      busy -= 1;
      job.control = null;
      if (job.view && jobs.get(trace.id) === job) waiting.push(job);
      next();
    }
  }

  /** Let go of a variable. */
  function drop(trace) {
    jobs.get(trace.id)?.control?.abort();
    jobs.delete(trace.id);
  }

  return { load, drop, isBusy: () => busy > 0 || waiting.length > 0 };
}

/** Load a variable's rows of a window, and a little around it. */
async function take(trace, view, points, signal) {
  const around = AROUND * (view.to - view.from);
  const { from, to } = partOf(trace, { from: view.from - around, to: view.to + around });
  const found = await rowsOf(trace, from, to, points, signal);
  const series = moved(found, -trace.origin);
  if (!trace.widest || series.of >= trace.widest.of) trace.widest = series;
  trace.series = withNeighbours(series, trace.widest, view.from, view.to);
  trace.problem = null;
}

async function rowsOf(trace, from, to, points, signal) {
  const path = `/api/v1/robots/${encodeURIComponent(trace.robot)}/query`;
  const query = new URLSearchParams({
    item: trace.item, variables: trace.variable, points,
    from: asked(Math.max(from + trace.origin, 0)), to: asked(to + trace.origin),
    format: trace.kind === "text" ? "json" : "plot",
  });
  if (trace.kind === "text") return wordsOf(await ask(`${path}?${query}`, { signal }), trace.names);
  const series = seriesOf(await askPlot(`${path}?${query}`, { signal }));
  return trace.codes.length ? placed(series, trace.codes) : series;
}
