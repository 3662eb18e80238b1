/**
 * All time of a robot as a bar: what is recorded, what is missing and why, and the window that is
 * shown, which one drags by its middle or its ends; arrow keys do the same.
 */

import { all, el, setText } from "../dom.js";
import { moment } from "../plot/time.js";
import { t } from "../strings.js";

const STEP = 0.1;
const BIG = 1;
const LEAST_S = 0.01;
const PARTS = ["from", "middle", "to"];

/**
 * Make the bar inside an element.
 * @param {HTMLElement} element
 * @param {function(number, number, boolean): void} moved the window; whether it goes on moving
 */
export function brush(element, moved) {
  const state = { start: 0, end: 1, from: 0, to: 1, moved, drag: null };
  const cover = el("div", { class: "brush-cover", "aria-hidden": "true" });
  const grips = Object.fromEntries(PARTS.map((name) => [name, gripOf(state, name)]));
  const ends = [el("span", { class: "brush-end" }), el("span", { class: "brush-end" })];
  const bar = el("div", { class: "brush-bar" }, cover, grips.middle, grips.from, grips.to);
  const legend = el("ul", { class: "brush-legend small muted" });
  const list = el("ul", { class: "sr-only" });
  element.replaceChildren(bar, el("div", { class: "spread small muted num" }, ends[0], legend, ends[1]), list);
  Object.assign(state, { bar, cover, grips, ends, legend, list });
  listen(state);
  return {
    /** Show what there is. @param {{start: number, end: number, recorded: any[], missing: any[]}} about */
    cover: (about) => showCover(state, about),
    /** Show a window: what of it lies on the bar. */
    window(from, to) {
      Object.assign(state, { from, to });
      if (!state.drag) place(state);
    },
  };
}

function gripOf(state, name) {
  const grip = el("div", { class: `brush-grip brush-${name}`, role: "slider", tabindex: "0", "data-grip": name,
    "aria-label": t(`data.brush.${name}`), title: t(`data.brush.${name}`) });
  grip.addEventListener("keydown", (event) => pressed(state, name, event));
  return grip;
}

const share = (state, time) => (time - state.start) / (state.end - state.start);
const clamped = (part) => Math.min(Math.max(part, 0), 1);

/** Put grips where the window is, and say it. */
function place(state) {
  const { grips, from, to } = state;
  const [left, right] = [from, to].map((time) => clamped(share(state, time)) * 100);
  grips.middle.style.setProperty("left", `${left}%`);
  grips.middle.style.setProperty("width", `${right - left}%`);
  grips.from.style.setProperty("left", `${left}%`);
  grips.to.style.setProperty("left", `${right}%`);
  const step = (to - from) / 100;
  for (const [name, time] of [["from", from], ["middle", (from + to) / 2], ["to", to]]) {
    const [least, most] = [Math.min(state.start, time), Math.max(state.end, time)]; // the window may reach off the bar
    const values = { "aria-valuemin": Math.floor(least), "aria-valuemax": Math.ceil(most), "aria-valuenow": Math.round(time),
      "aria-valuetext": moment(time, step) };
    for (const [key, value] of Object.entries(values)) grips[name].setAttribute(key, value);
  }
}

function showCover(state, { start, end, recorded, missing }) {
  Object.assign(state, { start, end });
  state.cover.replaceChildren(
    ...recorded.map((one) => stretch(state, one, "brush-recorded", t("data.brush.recorded"))),
    ...missing.map((one) => stretch(state, one, `brush-missing brush-${one.kind} plot-hatch-${one.kind}`, one.reason)));
  setText(state.ends[0], moment(start, 60));
  setText(state.ends[1], moment(end, 60));
  const kinds = [...new Set(missing.map((one) => one.kind))];
  state.legend.replaceChildren(keyOf("brush-recorded", t("data.brush.recorded")),
    ...kinds.map((kind) => keyOf(`brush-missing brush-${kind} plot-hatch-${kind}`, t(`plot.hole.${kind}`))));
  const lines = [...recorded.map((one) => [one, t("data.brush.recorded")]), ...missing.map((one) => [one, one.reason])];
  state.list.replaceChildren(...lines.map(([one, text]) => el("li", {},
    t("data.brush.stretch", { from: moment(one.start, 1), to: moment(one.end, 1), text }))));
  place(state);
}

function stretch(state, { start, end }, kind, text) {
  const shown = el("div", { class: kind, title: text });
  const [left, right] = [start, end].map((time) => clamped(share(state, time)) * 100);
  shown.style.setProperty("left", `${left}%`);
  shown.style.setProperty("width", `max(${right - left}%, 1px)`);
  return shown;
}

const keyOf = (kind, text) => el("li", {}, el("span", { class: `brush-key ${kind}`, "aria-hidden": "true" }), text);

/** The window after a grip has gone by some seconds. */
function gone({ from, to }, name, by) {
  if (name === "from") return [Math.min(from + by, to - LEAST_S), to];
  if (name === "to") return [from, Math.max(to + by, from + LEAST_S)];
  return [from + by, to + by];
}

function pressed(state, name, event) {
  const width = state.to - state.from;
  const by = { ArrowLeft: -STEP, ArrowDown: -STEP, ArrowRight: STEP, ArrowUp: STEP, PageDown: -BIG, PageUp: BIG }[event.key];
  const edge = { Home: state.start - (name === "to" ? state.to : state.from), End: state.end - (name === "from" ? state.from : state.to) }[event.key];
  if (by === undefined && edge === undefined) return;
  event.preventDefault();
  const far = by === undefined ? edge : by * width * (event.shiftKey ? BIG / STEP : 1);
  set(state, gone(state, name, far), false);
}

function set(state, [from, to], isMoving) {
  Object.assign(state, { from, to });
  place(state);
  state.moved(from, to, isMoving);
}

/** The window as a drag finds it: an end that lies off the bar is taken where its grip is seen. */
function seen({ start, end, from, to }, name) {
  if (name === "from") return { from: Math.min(Math.max(from, start), end), to };
  return name === "to" ? { from, to: Math.min(Math.max(to, start), end) } : { from, to };
}

/** Dragging: a grip, or a new window where there is none. */
function listen(state) {
  const { bar } = state;
  const timeAt = (event) => {
    const box = bar.getBoundingClientRect();
    return state.start + clamped((event.clientX - box.left) / box.width) * (state.end - state.start);
  };
  bar.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    const name = event.target.closest("[data-grip]")?.dataset.grip ?? "new";
    bar.setPointerCapture(event.pointerId);
    state.drag = { name, at: timeAt(event), x: event.clientX, isMoved: false, ...seen(state, name) };
  });
  bar.addEventListener("pointermove", (event) => {
    const { drag } = state;
    if (!drag || (!drag.isMoved && Math.abs(event.clientX - drag.x) < 3)) return;
    drag.isMoved = true;
    const now = timeAt(event);
    set(state, drag.name === "new" ? ordered(drag.at, now) : gone(drag, drag.name, now - drag.at), true);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    bar.addEventListener(name, (event) => {
      const { drag } = state;
      state.drag = null;
      if (!drag) return;
      if (drag.isMoved) set(state, [state.from, state.to], false);
      else if (drag.name === "new") set(state, gone(state, "middle", timeAt(event) - (state.from + state.to) / 2), false);
      for (const grip of all(`[data-grip="${drag.name}"]`, bar)) grip.focus({ preventScroll: true });
    });
  }
}

const ordered = (one, other) => [Math.min(one, other), Math.max(one, other, Math.min(one, other) + LEAST_S)];
