/** Hands on the plots: keyboard, wheel, double click, and two fingers. Dragging is uPlot's. */

import { panned, zoomed } from "./view.js";

const STEP_PX = 4;
const FACTOR = 0.5;
const WHEEL = 1.0015;
const PAN = 0.25;

/** Listen to an element for a stack. @param {HTMLElement} element @param {any} stack */
export function listenTo(element, stack, signal) {
  element.addEventListener("keydown", (event) => pressed(stack, event), { signal });
  element.addEventListener("dblclick", () => stack.back(), { signal });
  element.addEventListener("wheel", (event) => turned(stack, event), { passive: false, signal });
  fingers(element, stack, signal);
}

const KEYS = {
  ArrowLeft: (stack, event) => (event.shiftKey ? pan(stack, -PAN) : step(stack, -1)),
  ArrowRight: (stack, event) => (event.shiftKey ? pan(stack, PAN) : step(stack, 1)),
  PageUp: (stack) => pan(stack, -1),
  PageDown: (stack) => pan(stack, 1),
  "+": (stack) => stack.window(...ends(zoomed(stack.view, FACTOR, stack.cursor ?? undefined))),
  "=": (stack) => KEYS["+"](stack),
  "-": (stack) => stack.window(...ends(zoomed(stack.view, 1 / FACTOR, stack.cursor ?? undefined))),
  Home: (stack) => stack.all(),
  End: (stack) => stack.newest(),
  Escape: (stack) => stack.back(),
  Backspace: (stack) => stack.back(),
};

function pressed(stack, event) {
  const act = KEYS[event.key];
  if (!act || event.altKey || event.metaKey || event.ctrlKey) return;
  if (event.target.closest("button, a, input, summary, select, .scroll")) return;
  event.preventDefault();
  act(stack, event);
}

/** Move the cursor by some pixels; at the edge the window comes along. */
function step(stack, direction) {
  const { from, to } = stack.view;
  const px = (to - from) / stack.plotWidth();
  const time = (stack.cursor ?? (from + to) / 2) + direction * px * STEP_PX;
  if (time < from || time > to) pan(stack, direction * PAN);
  stack.cursorTo(time);
}

function pan(stack, part) {
  stack.window(...ends(panned(stack.view, part)), { soft: true });
}

function turned(stack, event) {
  if (event.ctrlKey) {
    event.preventDefault();
    const about = stack.timeAt(event.clientX);
    stack.window(...ends(zoomed(stack.view, WHEEL ** event.deltaY, about)), { soft: true });
  } else if (Math.abs(event.deltaX) > Math.abs(event.deltaY)) {
    event.preventDefault();
    pan(stack, event.deltaX / stack.plotWidth());
  }
}

/** One finger moves, two zoom. */
function fingers(element, stack, signal) {
  const down = new Map();
  const on = (name, fn) => element.addEventListener(name, fn, { signal });
  on("pointerdown", (event) => {
    if (event.pointerType === "touch" && event.target.closest(".plot-canvas")) down.set(event.pointerId, event.clientX);
  });
  on("pointermove", (event) => {
    if (!down.has(event.pointerId)) return;
    const before = [...down.values()];
    down.set(event.pointerId, event.clientX);
    grip(stack, before, [...down.values()]);
  });
  for (const name of ["pointerup", "pointercancel", "pointerleave"]) {
    on(name, (event) => down.delete(event.pointerId));
  }
}

/** Change the window so that the times below the fingers stay below them. */
function grip(stack, before, now) {
  if (now.length === 1) {
    pan(stack, (before[0] - now[0]) / stack.plotWidth());
    return;
  }
  const [wide, narrow] = [before, now].map(([one, other]) => Math.max(Math.abs(one - other), 10));
  const middle = (now[0] + now[1]) / 2;
  stack.window(...ends(zoomed(stack.view, wide / narrow, stack.timeAt(middle))), { soft: true });
}

const ends = ({ from, to }) => [from, to];
