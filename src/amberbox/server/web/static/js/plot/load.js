// Loading what plots show: values, statistics, gaps, and what happened meanwhile.

import { latestSignal, requestColumns, requestJson, robotApi } from "../api.js";
import { hasText, t } from "../strings.js";
import { debounce, secondsParam, stampToSeconds } from "../time.js";
import { partInWindow, seriesOf, shifted, textSeriesOf, toPlaces, withNeighbours } from "./series.js";

/**
 * Loading the values of the window. Of each variable one request is running; when the window has
 * moved meanwhile, the newest is requested next. What is shown stays until the next is there.
 */

const AT_ONCE = 4;
const PATIENCE_MS = 800;
const MARGIN_PART = 0.02;

/**
 * @param {{points: function(): number, loaded: function(any): void,
 *   failed: function(any, Error): void}} about
 */
export function valueLoader({ points, loaded, failed }) {
  const jobs = new Map();
  const waiting = [];
  let busy = 0;

  /** Load a variable for a window; aborts a running request only if it takes long. */
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
      await loadTrace(trace, view, points(), job.control.signal);
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

  /** Forget a variable. */
  function drop(trace) {
    jobs.get(trace.id)?.control?.abort();
    jobs.delete(trace.id);
  }

  return { load, drop, isBusy: () => busy > 0 || waiting.length > 0 };
}

/** Load the rows of a variable in a window, with a margin. */
async function loadTrace(trace, view, points, signal) {
  const around = MARGIN_PART * (view.to - view.from);
  const { from, to } = partInWindow(trace, { from: view.from - around, to: view.to + around });
  const found = await requestSeries(trace, from, to, points, signal);
  const series = shifted(found, -trace.origin);
  if (!trace.widest || series.of >= trace.widest.of) trace.widest = series;
  trace.series = withNeighbours(series, trace.widest, view.from, view.to);
  trace.problem = null;
}

async function requestSeries(trace, from, to, points, signal) {
  if (trace.request) return trace.request(from, to, points, signal);
  const path = `${robotApi(trace.robot)}/query`;
  const query = new URLSearchParams({
    item: trace.item, variables: trace.variable, points,
    from: secondsParam(Math.max(from + trace.origin, 0)), to: secondsParam(to + trace.origin),
    format: trace.kind === "text" ? "json" : "plot",
  });
  if (trace.kind === "text") return textSeriesOf(await requestJson(`${path}?${query}`, { signal }), trace.names);
  const series = seriesOf(await requestColumns(`${path}?${query}`, { signal }));
  return trace.codes.length ? toPlaces(series, trace.codes) : series;
}

/**
 * @typedef {object} Mark
 * @property {string} id @property {string} kind @property {number} from seconds
 * @property {?number} to seconds; null for a moment, and for what lasts
 * @property {string} text @property {string} href empty for none @property {string} level
 *
 * @typedef {{id: string, label: string, stretches: {from: number, to: number, level: string,
 *   text: string}[]}} Lane
 */

/**
 * Return the marks of a window: alarms, incidents, missions, notes.
 * @param {{alarms?: any[], incidents?: any[], missions?: any[], notes?: any[]}} around @returns {Mark[]}
 */
function marksOf({ alarms = [], incidents = [], missions = [], notes = [] }, { from, to }) {
  const lines = alarms.map(alarmMark).filter((mark) => mark.from < to && (mark.to === null || mark.to >= from));
  const ofMissions = missions.flatMap((one) => [missionMark(one), ...one.notes.map((note, n) => noteMark(`${one.id}-${n}`, note))]);
  const others = [...incidents.map(incidentMark), ...ofMissions, ...notes.map((note) => noteMark(note.id, note))];
  return [...lines, ...others].sort((one, other) => one.from - other.from);
}

/**
 * Return the lanes of states of components. @param {{timeline?: {lanes: any[]}}} around @returns {Lane[]}
 */
function lanesOf({ timeline = { lanes: [] } }) {
  return timeline.lanes.filter((lane) => !lane.mode)
    .map((lane) => ({ id: lane.component, label: lane.component, stretches: lane.stretches.map(laneState) }));
}

function laneState(one) {
  const words = [t(`common.level.${levelWord(one.level)}`), one.state, one.reason];
  const text = [...new Set(words.filter(Boolean))].join(", ");
  const more = one.changes > 1 ? ` (${t("plot.changes", { n: one.changes })})` : "";
  return { from: stampToSeconds(one.from), to: stampToSeconds(one.to), level: one.level, text: text + more };
}

/** Return the level whose text the catalogue has. */
function levelWord(level) {
  return hasText(`common.level.${level}`) ? level : "unknown";
}

function alarmMark(alarm) {
  return { id: `alarm-${alarm.id}`, kind: "alarm", from: stampToSeconds(alarm.opened), to: stampToSeconds(alarm.cleared),
    text: alarm.reason, href: `/alarms/${alarm.id}`, level: alarm.level };
}

function incidentMark(one) {
  return { id: `incident-${one.id}`, kind: "incident", from: stampToSeconds(one.from), to: stampToSeconds(one.to),
    text: one.reason || one.id, href: "", level: "" };
}

function missionMark(one) {
  const text = one.outcome ? t("plot.mission_ended", { name: one.name, outcome: one.outcome }) : one.name;
  return { id: `mission-${one.id}`, kind: "mission", from: stampToSeconds(one.from), to: stampToSeconds(one.to), text,
    href: "", level: one.failed ? "error" : "" };
}

function noteMark(id, note) {
  return { id: `note-${id}`, kind: "note", from: stampToSeconds(note.at), to: note.to ? stampToSeconds(note.to) : null,
    text: `${note.text} (${note.who})`, href: "", level: "" };
}

/**
 * Loading the context of the window, after its values: gaps, marks and lanes of states with one
 * request, statistics of each item with another.
 */

const PAUSE_MS = 250;

/** @param {any} stack */
export function contextLoader(stack) {
  const state = { robot: "", isBusy: false, isUnsure: false };

  const nextSignal = latestSignal();
  const loadSoon = debounce(load, PAUSE_MS);

  /** Show marks and lanes of a robot. @param {string} robot */
  function watch(robot) {
    if (robot !== state.robot) Object.assign(stack, { marks: [], lanes: [] });
    state.robot = robot;
    request();
  }

  /** Request the context, as soon as the window has not moved for a moment. */
  function request() {
    state.isBusy = true;
    loadSoon();
  }

  async function load() {
    if (stack.end.aborted) return;
    if (stack.loader.isBusy()) {
      request();
      return;
    }
    const signal = nextSignal();
    const traces = [...stack.traces.values()].filter((trace) => trace.isArchived);
    await Promise.all([...contextRequests(traces, signal), ...loadStatistics(traces, stack.view, signal)]);
    if (signal.aborted) return;
    state.isBusy = false;
    stack.redraw();
  }

  /** Yield one request for each origin of times: only one, except in comparisons. */
  function* contextRequests(traces, signal) {
    const withMarks = Boolean(state.robot) && !stack.options.relative;
    const lacking = stack.gaps.lacking(traces, stack.view);
    state.isUnsure &&= lacking.length > 0;
    const groups = [...Map.groupBy(lacking, (trace) => `${trace.robot}\n${trace.origin}`).values()];
    const isOwn = ([{ robot }]) => withMarks && robot === state.robot;
    for (const group of groups) yield loadContext(group[0].robot, group, isOwn(group), signal);
    if (withMarks && !groups.some(isOwn)) yield loadContext(state.robot, [], true, signal);
  }

  /** Load; if gaps fail, the legend tells so, and they are requested with the next window. */
  async function loadContext(robot, group, withMarks, signal) {
    const { view } = stack;
    const origin = group[0]?.origin ?? 0;
    const query = new URLSearchParams({ from: secondsParam(Math.max(view.from + origin, 0)), to: secondsParam(view.to + origin), marks: withMarks });
    for (const item of new Set(group.map((trace) => trace.item))) query.append("item", item);
    const found = await requestJson(`/robots/${encodeURIComponent(robot)}/data/around?${query}`, { signal }).catch(() => null);
    if (signal.aborted) return;
    if (group.length) state.isUnsure = !found?.gaps;
    for (const trace of found?.gaps ? group : []) stack.gaps.keep(trace, found.gaps, found.gaps.items[trace.item]);
    if (found && withMarks) Object.assign(stack, { marks: marksOf(found, view), lanes: lanesOf(found) });
  }

  return { watch, want: request, isBusy: () => state.isBusy, isUnsure: () => state.isUnsure };
}

/** Load statistics of the window, with one request for variables of one item. */
function loadStatistics(traces, view, signal) {
  const groups = Map.groupBy(traces.filter((trace) => trace.kind !== "text" && !trace.request),
    (trace) => `${trace.robot}\n${trace.item}\n${trace.origin}`);
  return [...groups.values()].map((group) => loadGroupStatistics(group, view, signal));
}

async function loadGroupStatistics(group, view, signal) {
  const [{ robot, item, origin }] = group;
  const { from, to } = partInWindow(group[0], view);
  const query = new URLSearchParams({ item, from: secondsParam(Math.max(from + origin, 0)), to: secondsParam(to + origin) });
  for (const trace of group) query.append("variables", trace.variable);
  const answer = await requestJson(`${robotApi(robot)}/statistics?${query}`, { signal }).catch(() => null);
  if (signal.aborted) return;
  group.forEach((trace, n) => { // without an answer the table is empty, not outdated
    trace.statistics = answer?.variables[n] ? { ...answer.variables[n], exact: answer.exact } : null;
  });
}
