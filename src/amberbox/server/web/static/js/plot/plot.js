// Plots over one window of time, stacked, with one cursor.

import { axisWidth } from "./axes.js";
import { onThemeChange, readColours } from "./draw.js";
import { plotFrame, updateFrame, updateValueTable } from "./frame.js";
import { contextLoader, valueLoader } from "./load.js";
import { destroyPanel, drawPanel, EDGE_PX, fitPanel, legendEntry, makePanel, pointPanel, scalesOf, updateLegendEntry } from "./panel.js";
import { appendLive, boundedWindow, gapCache, gapsUpTo, isSameWindow, liveRequest, panned, pushHistory, traceOf, trimLive, zoomed } from "./series.js";

const STEP_PX = 4;
const ZOOM_FACTOR = 0.5;
const WHEEL_FACTOR = 1.0015;
const PAN_PART = 0.25;

/** Listen to keys, wheel, double clicks and touch; dragging is left to uPlot. @param {HTMLElement} element @param {any} stack */
function listenForInput(element, stack, signal) {
  element.addEventListener("keydown", (event) => onKey(stack, event), { signal });
  element.addEventListener("dblclick", () => stack.back(), { signal });
  element.addEventListener("wheel", (event) => onWheel(stack, event), { passive: false, signal });
  listenForTouch(element, stack, signal);
}

const KEYS = {
  ArrowLeft: (stack, event) => (event.shiftKey ? panBy(stack, -PAN_PART) : stepCursor(stack, -1)),
  ArrowRight: (stack, event) => (event.shiftKey ? panBy(stack, PAN_PART) : stepCursor(stack, 1)),
  PageUp: (stack) => panBy(stack, -1),
  PageDown: (stack) => panBy(stack, 1),
  "+": (stack) => stack.window(...endsOf(zoomed(stack.view, ZOOM_FACTOR, stack.cursor ?? undefined))),
  "=": (stack) => KEYS["+"](stack),
  "-": (stack) => stack.window(...endsOf(zoomed(stack.view, 1 / ZOOM_FACTOR, stack.cursor ?? undefined))),
  Home: (stack) => stack.all(),
  End: (stack) => stack.newest(),
  Escape: (stack) => stack.back(),
  Backspace: (stack) => stack.back(),
};

function onKey(stack, event) {
  const act = KEYS[event.key];
  if (!act || event.altKey || event.metaKey || event.ctrlKey) return;
  if (event.target.closest("button, a, input, summary, select, .scroll")) return;
  event.preventDefault();
  act(stack, event);
}

/** Move the cursor by some pixels; at the edge the window moves, too. */
function stepCursor(stack, direction) {
  const { from, to } = stack.view;
  const px = (to - from) / stack.plotWidth();
  const time = (stack.cursor ?? (from + to) / 2) + direction * px * STEP_PX;
  if (time < from || time > to) panBy(stack, direction * PAN_PART);
  stack.cursorTo(time);
}

function panBy(stack, part) {
  stack.window(...endsOf(panned(stack.view, part)), { soft: true });
}

function onWheel(stack, event) {
  if (event.ctrlKey) {
    event.preventDefault();
    const about = stack.timeAt(event.clientX);
    stack.window(...endsOf(zoomed(stack.view, WHEEL_FACTOR ** event.deltaY, about)), { soft: true });
  } else if (Math.abs(event.deltaX) > Math.abs(event.deltaY)) {
    event.preventDefault();
    panBy(stack, event.deltaX / stack.plotWidth());
  }
}

/** One finger moves the window, two zoom it. */
function listenForTouch(element, stack, signal) {
  const down = new Map();
  const on = (name, fn) => element.addEventListener(name, fn, { signal });
  on("pointerdown", (event) => {
    if (event.pointerType === "touch" && event.target.closest(".plot-canvas")) down.set(event.pointerId, event.clientX);
  });
  on("pointermove", (event) => {
    if (!down.has(event.pointerId)) return;
    const before = [...down.values()];
    down.set(event.pointerId, event.clientX);
    moveByTouch(stack, before, [...down.values()]);
  });
  for (const name of ["pointerup", "pointercancel", "pointerleave"]) {
    on(name, (event) => down.delete(event.pointerId));
  }
}

/** Change the window so that the times below the fingers stay there. */
function moveByTouch(stack, before, now) {
  if (now.length === 1) {
    panBy(stack, (before[0] - now[0]) / stack.plotWidth());
    return;
  }
  const [wide, narrow] = [before, now].map(([one, other]) => Math.max(Math.abs(one - other), 10));
  const middle = (now[0] + now[1]) / 2;
  stack.window(...endsOf(zoomed(stack.view, wide / narrow, stack.timeAt(middle))), { soft: true });
}

const endsOf = ({ from, to }) => [from, to];

const RELOAD_MS = 5000;

/** Append live values, and follow them until somebody moves the window. @param {any} stack */
function liveMode(stack) {
  const state = { feed: null, following: false, askedMs: 0, heard: new WeakSet() };
  const traces = () => [...stack.traces.values()];
  const emitState = () => stack.options.onLive?.(state.feed ? (state.following ? "on" : "paused") : "off");

  /** Start with a feed (`feed.js`), or end with null. */
  function start(feed) {
    state.feed?.want({ live: {} });
    state.feed = feed;
    if (feed && !state.heard.has(feed)) {
      state.heard.add(feed);
      feed.on("live", (data, robot) => onValues(feed, data, robot));
    }
    state.askedMs = performance.now();
    state.following = Boolean(feed);
    ask();
    emitState();
  }

  /** Request the variables that are shown now from the feed. */
  function ask() {
    state.feed?.want({ live: liveRequest(traces()) });
  }

  function onValues(feed, data, robot) {
    if (feed !== state.feed) return;
    const newest = appendLive(traces(), robot, data);
    if (newest === null) return;
    stack.whole = { ...stack.whole, to: Math.max(stack.whole.to, newest) };
    if (state.following && newest >= stack.view.from) move(newest); // the first value may be old
    stack.redraw();
  }

  function move(newest) {
    const width = stack.view.to - stack.view.from;
    stack.view = { from: newest - width, to: newest };
    if (performance.now() - state.askedMs < RELOAD_MS) return;
    state.askedMs = performance.now();
    stack.want();
  }

  /** Stop following: the user has moved the window. */
  function pause() {
    if (!state.feed || !state.following) return;
    state.following = false;
    emitState();
  }

  /** Follow the newest values again. */
  function follow() {
    if (!state.feed) return;
    state.following = true;
    emitState();
  }

  return { start, ask, pause, follow, loaded: trimLive };
}

const NARROW_PX = 620;

/** Redraw when the width of the panels changes. @param {any} stack @param {AbortSignal} signal */
function watchSize(stack, signal) {
  const look = () => {
    const width = Math.floor(stack.frame.panels.clientWidth);
    if (width === stack.width) return;
    stack.width = width;
    stack.narrow = width < NARROW_PX;
    stack.redraw();
  };
  const watcher = new ResizeObserver(look);
  watcher.observe(stack.frame.panels);
  signal.addEventListener("abort", () => watcher.disconnect());
  look();
}

/**
 * @typedef {object} Options
 * @property {number} from @property {number} to the window, in seconds since 1970; of a relative
 *   stack seconds since each variable's `origin`
 * @property {{from: number, to: number}} [whole] what Home shows; the first window if left out
 * @property {boolean} [relative] the axis counts from each variable's `origin` (to compare missions)
 * @property {boolean} [fixed] variables cannot be taken away by hand
 * @property {function(number, number): void} [onWindow] the window has changed
 * @property {function(string): void} [onRemove] somebody took a variable away
 * @property {function("on"|"paused"|"off"): void} [onLive] live values are followed, paused, off
 *
 * @typedef {object} TraceOptions a variable to show
 * @property {string} id chosen by the caller
 * @property {string} robot @property {string} item @property {string} variable
 * @property {string} [label] @property {string} [unit]
 * @property {Record<string, string>} [labels] names of values
 * @property {"number"|"enum"|"bool"|"text"} [kind] see `kindOf`
 * @property {string} [panel] variables of one panel lie over each other; else each has its own
 * @property {number} [origin] seconds that are the zero of its time axis (0)
 * @property {boolean} [isArchived] false for one of which there are live values only
 * @property {number} [length] seconds after `origin` that are shown, of a mission; else all
 * @property {number} [colour] which of the colours of curves, from 0; else one that is free
 * @property {function(number, number, number, AbortSignal): Promise<any>} [request] loads the series
 *   of what is computed: from, to (s), points; `item` is then what it is computed from
 */

const SOFT_MS = 120;
const SOFT_PAUSE_MS = 700;
const MOST_POINTS = 5000;
const LEAST_POINTS = 200;

/**
 * Make a stack of plots inside an element.
 * @param {HTMLElement} element @param {Options} options
 */
export function plots(element, options) {
  const end = new AbortController();
  const stack = {
    options, view: boundedWindow(options), whole: options.whole ?? boundedWindow(options), cursor: null, marks: [], lanes: [],
    traces: new Map(), panels: new Map(), keys: new Map(), history: [], softMs: -Infinity, asking: 0, drawing: 0,
    end: end.signal, width: 0, narrow: false,
  };
  Object.assign(stack, windowFunctions(stack), cursorFunctions(stack), traceFunctions(stack));
  stack.frame = plotFrame(stack, element);
  stack.colours = { now: readColours(stack.frame.root) };
  stack.gaps = gapCache();
  stack.around = contextLoader(stack);
  stack.live = liveMode(stack);
  stack.loader = valueLoader({
    points: () => Math.round(Math.min(Math.max(2 * stack.plotWidth(), LEAST_POINTS), MOST_POINTS)),
    loaded: (trace) => onLoaded(stack, trace),
    failed: (trace, error) => {
      trace.problem = error;
      stack.redraw();
    },
  });
  listenForInput(stack.frame.plots, stack, end.signal);
  onThemeChange(() => {
    stack.colours.now = readColours(stack.frame.root);
    drawAll(stack);
  }, end.signal);
  watchSize(stack, end.signal);
  return publicApi(stack, end);
}

/** Return the functions of a stack for pages. */
function publicApi(stack, end) {
  return {
    add: stack.add, remove: stack.remove, window: stack.window, back: stack.back, all: stack.all,
    cursorTo: stack.cursorTo, live: stack.live.start, follow: stack.live.follow, watch: stack.around.watch,
    /** Load everything again. */
    refresh() {
      stack.gaps.forget();
      for (const trace of stack.traces.values()) trace.asked = null;
      stack.want();
    },
    /** Set what Home shows. @param {{from: number, to: number}} whole */
    setWhole(whole) {
      stack.whole = whole;
    },
    /** Return window, cursor and variables; `settled` when everything for them is loaded and drawn. */
    now: () => ({ ...stack.view, cursor: stack.cursor, traces: [...stack.traces.values()],
      settled: !stack.asking && !stack.drawing && !stack.loader.isBusy() && !stack.around.isBusy() }),
    destroy() {
      end.abort();
      stack.live.start(null);
      for (const panel of stack.panels.values()) destroyPanel(panel);
      stack.frame.root.remove();
    },
  };
}

/** Functions that add and remove variables. */
function traceFunctions(stack) {
  /** Show a variable. @param {TraceOptions} about */
  function add(about) {
    stack.remove(about.id);
    const used = new Set([...stack.traces.values()].map((trace) => trace.colour));
    const trace = traceOf(about, used);
    stack.traces.set(trace.id, trace);
    const panel = stack.panels.get(trace.panel) ?? addPanel(stack, trace.panel);
    panel.traces.push(trace);
    const key = legendEntry(panel, trace);
    stack.keys.set(trace.id, key);
    panel.legend.append(key.root);
    stack.live.ask();
    stack.redraw();
    stack.want();
  }

  /** Remove a variable. @param {string} id */
  function remove(id) {
    const trace = stack.traces.get(id);
    if (!trace) return;
    stack.traces.delete(id);
    stack.loader.drop(trace);
    stack.keys.get(id).root.remove();
    stack.keys.delete(id);
    const panel = stack.panels.get(trace.panel);
    panel.traces = panel.traces.filter((one) => one !== trace);
    if (!panel.traces.length) {
      destroyPanel(panel);
      stack.panels.delete(trace.panel);
    }
    stack.live.ask();
    stack.redraw();
  }

  function drop(id) {
    remove(id);
    stack.options.onRemove?.(id);
    stack.frame.plots.focus();
  }

  const gapsOf = (trace) => gapsUpTo(trace, stack.gaps.of(trace), trace.live ? trace.live.x[0] : stack.view.to);
  return { add, remove, drop, gapsOf };
}

function addPanel(stack, name) {
  const panel = makePanel(stack, name);
  stack.panels.set(name, panel);
  stack.frame.panels.append(panel.root);
  return panel;
}

/** Functions that move the window. */
function windowFunctions(stack) {
  /**
   * Show a window. `soft`: one of many small moves; `silent`: not moved by the user, and not in the
   * history.
   */
  function window(from, to, { soft = false, silent = false } = {}) {
    const view = boundedWindow({ from, to });
    if (isSameWindow(view, stack.view)) return;
    if (!silent) {
      stack.live.pause();
      const nowMs = performance.now();
      if (!soft || nowMs - stack.softMs > SOFT_PAUSE_MS) pushHistory(stack.history, stack.view);
      if (soft) stack.softMs = nowMs;
    }
    show(view, soft);
  }

  function show(view, soft) {
    stack.view = view;
    for (const trace of stack.traces.values()) trace.statistics = null; // of another window
    stack.redraw();
    clearTimeout(stack.asking);
    stack.asking = soft ? setTimeout(settled, SOFT_MS) : 0;
    if (!soft) settled();
  }

  function settled() {
    stack.asking = 0;
    want();
    stack.options.onWindow?.(stack.view.from, stack.view.to);
  }

  /** Load what the window lacks. */
  function want() {
    const traces = [...stack.traces.values()];
    for (const trace of traces) {
      if (!trace.isArchived || (trace.asked && isSameWindow(trace.asked, stack.view))) continue;
      trace.asked = stack.view;
      stack.loader.load(trace, stack.view);
    }
    stack.around.want();
  }

  function back() {
    const last = stack.history.pop();
    if (last) show(last, false);
  }

  const all = () => window(stack.whole.from, stack.whole.to);
  const newest = () => window(stack.whole.to - (stack.view.to - stack.view.from), stack.whole.to);
  const zoom = (from, to) => window(from, to);
  return { window, show, want, back, all, newest, zoom };
}

/** Functions of the cursor, positions and drawing. */
function cursorFunctions(stack) {
  const left = () => axisWidth(stack.narrow);
  const rights = () => Math.max(0, ...[...stack.panels.values()].map((panel) => scalesOf(panel).length - 1));
  const plotWidth = () => Math.max(stack.width - left() - EDGE_PX - rights() * axisWidth(stack.narrow), 50);

  /** Move the cursor of all panels but `source`, in which it was moved. */
  function pointed(time, source) {
    if (stack.cursor === time) return;
    stack.cursor = time;
    for (const panel of stack.panels.values()) if (panel !== source) pointPanel(panel, time);
    updateValues(stack);
  }

  /** Put the cursor at a time, and announce the values to screen readers. @param {number} time */
  function cursorTo(time) {
    const { from, to } = stack.view;
    if (time < from || time > to) {
      const half = (to - from) / 2;
      stack.window(time - half, time + half);
    }
    pointed(time, null);
    stack.redraw();
    stack.frame.say();
  }

  function timeAt(clientX) {
    const box = stack.frame.panels.getBoundingClientRect();
    const part = (clientX - box.left - left()) / plotWidth();
    return stack.view.from + Math.min(Math.max(part, 0), 1) * (stack.view.to - stack.view.from);
  }

  function strengthen(panel, id) {
    panel.strong = id;
    stack.redraw();
  }

  function redraw() {
    stack.drawing ||= requestAnimationFrame(() => {
      stack.drawing = 0;
      if (!stack.end.aborted) drawAll(stack);
    });
  }
  return { left, rights, plotWidth, pointed, cursorTo, timeAt, strengthen, redraw };
}

function drawAll(stack) {
  const panels = [...stack.panels.values()];
  const about = { width: stack.width, rights: stack.rights(), narrow: stack.narrow };
  if (stack.width > 0) {
    panels.forEach((panel, n) => {
      fitPanel(panel, { ...about, last: n === panels.length - 1 });
      drawPanel(panel);
      pointPanel(panel, stack.cursor);
    });
    updateFrame(stack);
  }
  updateValues(stack);
}

function updateValues(stack) {
  const traces = [...stack.traces.values()];
  for (const trace of traces) updateLegendEntry(stack.keys.get(trace.id), trace, stack);
  updateValueTable(stack.frame.readout, traces, stack.cursor);
  stack.frame.showTime();
}

/** Draw a loaded variable, and dispatch `plotdrawn`. */
function onLoaded(stack, trace) {
  stack.live.loaded(trace);
  if (stack.drawing) cancelAnimationFrame(stack.drawing);
  stack.drawing = 0;
  drawAll(stack);
  stack.frame.root.dispatchEvent(new CustomEvent("plotdrawn", { bubbles: true, detail: { id: trace.id } }));
}
