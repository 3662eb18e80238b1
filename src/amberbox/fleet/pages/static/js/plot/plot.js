/**
 * Stacked plots over one window of time, with one cursor.
 *
 * @typedef {object} Options
 * @property {number} from @property {number} to the window, in seconds since 1970; of a relative
 *   stack seconds since each variable's `origin`
 * @property {{from: number, to: number}} [whole] what Home shows; the first window if left out
 * @property {boolean} [relative] the axis counts from each variable's `origin` (to compare missions)
 * @property {boolean} [fixed] variables cannot be taken away by hand
 * @property {function(number, number): void} [onWindow] the window has changed
 * @property {function(?number): void} [onCursor] the cursor has moved
 * @property {function(string): void} [onRemove] somebody took a variable away
 * @property {function("on"|"paused"|"off"): void} [onLive] live values go on, wait, have ended
 *
 * @typedef {object} Added
 * @property {string} id one's own name of it
 * @property {string} robot @property {string} item @property {string} variable
 * @property {string} [label] @property {string} [unit]
 * @property {Record<string, string>} [labels] names of values
 * @property {"number"|"enum"|"bool"|"text"} [kind] see `kindOf`
 * @property {string} [panel] variables of one panel lie over each other; else each has its own
 * @property {number} [origin] seconds that are the zero of its time (0)
 * @property {number} [length] seconds behind `origin` that are shown, of a mission; else all
 */

import { axisWidth } from "./axes.js";
import { gapKeeper, holesOf } from "./gaps.js";
import { listenTo } from "./input.js";
import { makeKey, writeKey } from "./keys.js";
import { following } from "./follow.js";
import { loader } from "./load.js";
import { colours, onTheme } from "./look.js";
import { EDGE, destroy, draw, fit, panel, point, scalesOf } from "./panel.js";
import { frameOf, showAround } from "./frame.js";
import { surroundings } from "./around.js";
import { traceOf } from "./trace.js";
import { watchSize } from "./size.js";
import { isSame, remember, sane } from "./view.js";
import { fill } from "./table.js";

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
    options, view: sane(options), whole: options.whole ?? sane(options), cursor: null, marks: [], lanes: [],
    traces: new Map(), panels: new Map(), keys: new Map(), history: [], softMs: -Infinity, asking: 0, drawing: 0,
    end: end.signal, width: 0, narrow: false,
  };
  Object.assign(stack, views(stack), pointers(stack), members(stack));
  stack.frame = frameOf(stack, element);
  stack.colours = { now: colours(stack.frame.root) };
  stack.gaps = gapKeeper();
  stack.around = surroundings(stack);
  stack.live = following(stack);
  stack.loader = loader({
    points: () => Math.round(Math.min(Math.max(2 * stack.plotWidth(), LEAST_POINTS), MOST_POINTS)),
    loaded: (trace) => arrived(stack, trace),
    failed: (trace, error) => {
      trace.problem = error;
      stack.redraw();
    },
  });
  listenTo(stack.frame.plots, stack, end.signal);
  onTheme(() => {
    stack.colours.now = colours(stack.frame.root);
    stack.redraw();
  }, end.signal);
  watchSize(stack, end.signal);
  return published(stack, end);
}

/** What pages may do with a stack. */
function published(stack, end) {
  return {
    add: stack.add, remove: stack.remove, window: stack.window, back: stack.back, all: stack.all,
    cursorTo: stack.cursorTo, live: stack.live.start, follow: stack.live.follow, watch: stack.around.watch,
    /** Ask for everything again: something has changed on the server. */
    refresh() {
      stack.gaps.forget();
      for (const trace of stack.traces.values()) trace.asked = null;
      stack.want();
    },
    /** Say what Home shows. @param {{from: number, to: number}} whole */
    setWhole(whole) {
      stack.whole = whole;
    },
    /** What is shown: window, cursor and variables; `settled` when everything for it has come. */
    now: () => ({ ...stack.view, cursor: stack.cursor, traces: [...stack.traces.values()],
      settled: !stack.asking && !stack.drawing && !stack.loader.isBusy() && !stack.around.isBusy() }),
    destroy() {
      end.abort();
      stack.live.start(null);
      for (const shown of stack.panels.values()) destroy(shown);
      stack.frame.root.remove();
    },
  };
}

/** Variables come and go. */
function members(stack) {
  /** Show a variable. @param {Added} about */
  function add(about) {
    stack.remove(about.id);
    const used = new Set([...stack.traces.values()].map((trace) => trace.colour));
    const trace = traceOf(about, used);
    stack.traces.set(trace.id, trace);
    const shown = stack.panels.get(trace.panel) ?? addPanel(stack, trace.panel);
    shown.traces.push(trace);
    const key = makeKey(shown, trace);
    stack.keys.set(trace.id, key);
    shown.legend.append(key.root);
    stack.live.ask();
    stack.redraw();
    stack.want();
  }

  /** Take a variable away. @param {string} id */
  function remove(id) {
    const trace = stack.traces.get(id);
    if (!trace) return;
    stack.traces.delete(id);
    stack.loader.drop(trace);
    stack.keys.get(id).root.remove();
    stack.keys.delete(id);
    const shown = stack.panels.get(trace.panel);
    shown.traces = shown.traces.filter((one) => one !== trace);
    if (!shown.traces.length) {
      destroy(shown);
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

  const gapsOf = (trace) => holesOf(trace, stack.gaps.of(trace), trace.live ? trace.live.x[0] : stack.view.to);
  return { add, remove, drop, gapsOf };
}

function addPanel(stack, name) {
  const shown = panel(stack, name);
  stack.panels.set(name, shown);
  stack.frame.panels.append(shown.root);
  return shown;
}

/** The window moves. */
function views(stack) {
  /**
   * Show a window. `soft`: one of many small moves; `silent`: not the user's doing, and not one to
   * come back from.
   */
  function window(from, to, { soft = false, silent = false } = {}) {
    const view = sane({ from, to });
    if (isSame(view, stack.view)) return;
    if (!silent) {
      stack.live.pause();
      const nowMs = performance.now();
      if (!soft || nowMs - stack.softMs > SOFT_PAUSE_MS) remember(stack.history, stack.view);
      if (soft) stack.softMs = nowMs;
    }
    show(view, soft);
  }

  function show(view, soft) {
    stack.view = view;
    for (const trace of stack.traces.values()) trace.sums = null; // they were of another window
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

  /** Ask for what the window shows and is not there. */
  function want() {
    const traces = [...stack.traces.values()];
    for (const trace of traces) {
      if (trace.asked && isSame(trace.asked, stack.view)) continue;
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

/** The cursor moves. */
function pointers(stack) {
  const left = () => axisWidth(stack.narrow);
  const rights = () => Math.max(0, ...[...stack.panels.values()].map((shown) => scalesOf(shown).length - 1));
  const plotWidth = () => Math.max(stack.width - left() - EDGE - rights() * axisWidth(stack.narrow), 50);

  /** The cursor was moved in a panel: the others follow. */
  function pointed(time, source) {
    if (stack.cursor === time) return;
    stack.cursor = time;
    for (const shown of stack.panels.values()) if (shown !== source) point(shown, time);
    writeValues(stack);
    stack.options.onCursor?.(time);
  }

  /** Put the cursor somewhere, and say what is there. @param {number} time */
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

  function strengthen(shown, id) {
    shown.strong = id;
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
    panels.forEach((shown, n) => {
      fit(shown, { ...about, last: n === panels.length - 1 });
      draw(shown);
      point(shown, stack.cursor);
    });
    showAround(stack);
  }
  writeValues(stack);
}

function writeValues(stack) {
  const traces = [...stack.traces.values()];
  for (const trace of traces) writeKey(stack.keys.get(trace.id), trace, stack);
  fill(stack.frame.readout, traces, stack.cursor);
  stack.frame.showTime();
}

/** Draw what was loaded, and say so to who waits for it. */
function arrived(stack, trace) {
  stack.live.loaded(trace);
  if (stack.drawing) cancelAnimationFrame(stack.drawing);
  stack.drawing = 0;
  drawAll(stack);
  stack.frame.root.dispatchEvent(new CustomEvent("plotdrawn", { bubbles: true, detail: { id: trace.id } }));
}
