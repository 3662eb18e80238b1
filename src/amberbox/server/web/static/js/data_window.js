// The window of time of the data page: from the address, the form, or the bar of all time.

import { requestJson } from "./api.js";
import { windowOf, withMargin } from "./data_actions.js";
import { el, find, findAll, setText } from "./dom.js";
import { dateTime } from "./plot/axes.js";
import { boundedWindow } from "./plot/series.js";
import { t } from "./strings.js";
import { fieldToSeconds, msToField, parseTime } from "./time.js";

const HOUR_S = 3600;
const RECENT_PART = 0.25;

/**
 * Resolve the view of an address to its window and the missions it compares. If a mission cannot be
 * loaded, `onError` is called, and the newest hour takes its place.
 * @param {import("./data.js").View} view @param {string} path of the robot in the API
 * @param {{now: number, last: ?number}} reference @param {function(Error): void} onError
 */
export async function resolveView(view, path, reference, onError) {
  try {
    const missions = await Promise.all(view.compare.map((id) => requestJson(missionPath(path, id))));
    return { view, missions, window: await resolveWindow(view, path, reference) };
  } catch (error) {
    onError(error);
    const fallback = { ...view, mission: "", compare: [] };
    return { view: fallback, missions: [], window: await resolveWindow(fallback, path, reference) };
  }
}

const missionPath = (path, id) => `${path}/missions/${encodeURIComponent(id)}`;

/**
 * Return the window of a view: a mission, two times, or the newest hour.
 * @param {import("./data.js").View} view @param {string} path of the robot in the API
 * @param {{now: number, last: ?number}} reference
 */
async function resolveWindow({ from, to, mission, live }, path, reference) {
  if (mission && !from && !to) {
    const [start, end] = withMargin(windowOf(await requestJson(missionPath(path, mission))));
    return { from: start, to: end };
  }
  const newest = live || from.startsWith("now") ? reference.now : newestEnd(HOUR_S, reference);
  const end = parseTime(to, reference) ?? newest;
  const start = parseTime(from, reference) ?? end - HOUR_S;
  return boundedWindow(start < end ? { from: start, to: end } : { from: end - HOUR_S, to: end });
}

/** Return the end of a window that holds the newest data: now, unless they are much older. */
export function newestEnd(width, { now, last }) {
  return last === null || now - last < width * RECENT_PART ? now : last;
}

/**
 * Return the range of all data of a robot; `window` if there are none.
 * @param {?Coverage} coverage @param {{first: ?number, last: ?number}} range
 * @param {import("./plot/series.js").Span} window
 */
export function wholeRange(coverage, { first, last }, window) {
  const known = [coverage?.start, coverage?.end, first, last].filter((time) => time !== null && time !== undefined);
  return known.length ? boundedWindow({ from: Math.min(...known), to: Math.max(...known) }) : window;
}

/**
 * What is recorded of a robot, and what is missing.
 *
 * @typedef {{start: ?number, end: ?number, recorded: {start: number, end: number}[],
 *   missing: {start: number, end: number, kind: string, reason: string}[]}} Coverage seconds;
 *   null without data
 */

// part of a window that may be without data at its end before the robot is mentioned
const TOLERATED_PART = 0.05;
const NO_COVERAGE = { start: null, end: null, recorded: [], missing: [] };

/** Load the coverage; null when that fails. @returns {Promise<?Coverage>} */
export async function loadCoverage(robot) {
  const answer = await requestJson(`/robots/${encodeURIComponent(robot)}/data/coverage`).catch(() => null);
  return answer && answer.start === null ? NO_COVERAGE : answer;
}

/**
 * Tell whether the robot may have data of a window that are not on the server.
 * @param {Coverage} coverage @param {{from: number, to: number}} window @param {number} now
 */
export function mayHaveMore(coverage, { from, to }, now) {
  const isBeyond = coverage.end === null || to - coverage.end > TOLERATED_PART * (to - from);
  const isPending = coverage.missing.some((gap) => gap.kind === "to_come" && gap.start < to && gap.end > from);
  return (isBeyond && from < now) || isPending;
}

/**
 * Start the form of the window: its length, two times, or live; and the mode of drawing.
 * @param {HTMLFormElement} form
 * @param {{newest: function(number): void, go: function(number, number): void, everything: function(): void,
 *   live: function(boolean): void, mode: function(string): void}} actions
 */
export function windowForm(form, actions) {
  const button = find("#live");
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("click", (event) => {
    const { width, all: isAll } = event.target.closest("button")?.dataset ?? {};
    if (width) actions.newest(Number(width));
    if (isAll !== undefined) actions.everything();
  });
  form.addEventListener("change", () => {
    const [from, until] = ["from", "to"].map((name) => fieldToSeconds(form.elements[name].value));
    const isValid = from !== null && until !== null && from < until;
    form.elements.to.setCustomValidity(isValid ? "" : t("data.window.wrong"));
    if (isValid) actions.go(from, until);
    else form.elements.to.reportValidity();
  });
  button?.addEventListener("click", () => actions.live(button.dataset.state !== "on"));
  for (const modeButton of findAll("[data-mode]")) modeButton.addEventListener("click", () => actions.mode(modeButton.dataset.mode));

  return {
    window(from, until) {
      for (const [name, time] of [["from", from], ["to", until]]) {
        const field = form.elements[name];
        if (document.activeElement !== field) field.value = msToField(time * 1000);
        field.setCustomValidity("");
      }
      for (const chip of findAll("[data-width]", form)) chip.setAttribute("aria-pressed", String(Math.abs(until - from - Number(chip.dataset.width)) < 1));
    },
    live(state) {
      button.dataset.state = state;
      button.setAttribute("aria-pressed", String(state === "on"));
      setText(find(".word", button), t(`data.live.${state}`));
    },
    mode(mode) {
      for (const modeButton of findAll("[data-mode]")) modeButton.setAttribute("aria-pressed", String(modeButton.dataset.mode === mode));
      button.hidden = mode !== "time";
    },
  };
}

const KEY_STEP = 0.1;
const PAGE_STEP = 1;
const LEAST_S = 0.01;
const GRIPS = ["from", "middle", "to"];

/**
 * Make the timeline of a robot inside an element: a bar of what is recorded, what is missing and
 * why, and the shown window, moved and resized by dragging and by keys.
 * @param {HTMLElement} element
 * @param {function(number, number, boolean): void} moved gets the window, and whether it is still moving
 */
export function timelineBrush(element, moved) {
  const state = { start: 0, end: 1, from: 0, to: 1, moved, drag: null };
  const cover = el("div", { class: "brush-cover", "aria-hidden": "true" });
  const grips = Object.fromEntries(GRIPS.map((name) => [name, gripElement(state, name)]));
  const ends = [el("span", { class: "brush-end" }), el("span", { class: "brush-end" })];
  const bar = el("div", { class: "brush-bar" }, cover, grips.middle, grips.from, grips.to);
  const legend = el("ul", { class: "brush-legend small muted" });
  const list = el("ul", { class: "sr-only" });
  element.replaceChildren(bar, el("div", { class: "spread small muted num" }, ends[0], legend, ends[1]), list);
  Object.assign(state, { bar, cover, grips, ends, legend, list });
  listenForDrags(state);
  return {
    /** @param {{start: number, end: number, recorded: any[], missing: any[]}} coverage */
    coverage: (coverage) => showCoverage(state, coverage),
    window(from, to) {
      Object.assign(state, { from, to });
      if (!state.drag) placeGrips(state);
    },
  };
}

function gripElement(state, name) {
  const grip = el("div", { class: `brush-grip brush-${name}`, role: "slider", tabindex: "0", "data-grip": name,
    "aria-label": t(`data.brush.${name}`), title: t(`data.brush.${name}`) });
  grip.addEventListener("keydown", (event) => onGripKey(state, name, event));
  return grip;
}

const partOfBar = (state, time) => (time - state.start) / (state.end - state.start);
const clampPart = (part) => Math.min(Math.max(part, 0), 1);

/** Put the grips at the ends of the window, and name its times for screen readers. */
function placeGrips(state) {
  const { grips, from, to } = state;
  const [left, right] = [from, to].map((time) => clampPart(partOfBar(state, time)) * 100);
  grips.middle.style.setProperty("left", `${left}%`);
  grips.middle.style.setProperty("width", `${right - left}%`);
  grips.from.style.setProperty("left", `${left}%`);
  grips.to.style.setProperty("left", `${right}%`);
  const step = (to - from) / 100;
  for (const [name, time] of [["from", from], ["middle", (from + to) / 2], ["to", to]]) {
    const [least, most] = [Math.min(state.start, time), Math.max(state.end, time)]; // the window may extend beyond the bar
    const values = { "aria-valuemin": Math.floor(least), "aria-valuemax": Math.ceil(most), "aria-valuenow": Math.round(time),
      "aria-valuetext": dateTime(time, step) };
    for (const [key, value] of Object.entries(values)) grips[name].setAttribute(key, value);
  }
}

function showCoverage(state, { start, end, recorded, missing }) {
  Object.assign(state, { start, end });
  state.cover.replaceChildren(
    ...recorded.map((interval) => intervalElement(state, interval, "brush-recorded", t("data.brush.recorded"))),
    ...missing.map((interval) => intervalElement(state, interval, `brush-missing brush-${interval.kind} plot-hatch-${interval.kind}`, interval.reason)));
  setText(state.ends[0], dateTime(start, 60));
  setText(state.ends[1], dateTime(end, 60));
  const kinds = [...new Set(missing.map((interval) => interval.kind))];
  state.legend.replaceChildren(legendEntry("brush-recorded", t("data.brush.recorded")),
    ...kinds.map((kind) => legendEntry(`brush-missing brush-${kind} plot-hatch-${kind}`, t(`plot.hole.${kind}`))));
  const lines = [...recorded.map((interval) => [interval, t("data.brush.recorded")]), ...missing.map((interval) => [interval, interval.reason])];
  state.list.replaceChildren(...lines.map(([interval, text]) => el("li", {},
    t("data.brush.stretch", { from: dateTime(interval.start, 1), to: dateTime(interval.end, 1), text }))));
  placeGrips(state);
}

function intervalElement(state, { start, end }, kind, text) {
  const element = el("div", { class: kind, title: text });
  const [left, right] = [start, end].map((time) => clampPart(partOfBar(state, time)) * 100);
  element.style.setProperty("left", `${left}%`);
  element.style.setProperty("width", `max(${right - left}%, 1px)`);
  return element;
}

const legendEntry = (kind, text) => el("li", {}, el("span", { class: `brush-key ${kind}`, "aria-hidden": "true" }), text);

/** Return the window after a grip was moved by some seconds. */
function movedWindow({ from, to }, name, by) {
  if (name === "from") return [Math.min(from + by, to - LEAST_S), to];
  if (name === "to") return [from, Math.max(to + by, from + LEAST_S)];
  return [from + by, to + by];
}

function onGripKey(state, name, event) {
  const width = state.to - state.from;
  const by = { ArrowLeft: -KEY_STEP, ArrowDown: -KEY_STEP, ArrowRight: KEY_STEP, ArrowUp: KEY_STEP, PageDown: -PAGE_STEP, PageUp: PAGE_STEP }[event.key];
  const edge = { Home: state.start - (name === "to" ? state.to : state.from), End: state.end - (name === "from" ? state.from : state.to) }[event.key];
  if (by === undefined && edge === undefined) return;
  event.preventDefault();
  const far = by === undefined ? edge : by * width * (event.shiftKey ? PAGE_STEP / KEY_STEP : 1);
  setWindow(state, movedWindow(state, name, far), false);
}

function setWindow(state, [from, to], isMoving) {
  Object.assign(state, { from, to });
  placeGrips(state);
  state.moved(from, to, isMoving);
}

/** Return the window that a drag begins with: an end beyond the bar is where its grip is visible. */
function visibleWindow({ start, end, from, to }, name) {
  if (name === "from") return { from: Math.min(Math.max(from, start), end), to };
  return name === "to" ? { from, to: Math.min(Math.max(to, start), end) } : { from, to };
}

/** Let grips be dragged, and new windows be drawn beside them. */
function listenForDrags(state) {
  const { bar } = state;
  const timeAt = (event) => {
    const box = bar.getBoundingClientRect();
    return state.start + clampPart((event.clientX - box.left) / box.width) * (state.end - state.start);
  };
  bar.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    const name = event.target.closest("[data-grip]")?.dataset.grip ?? "new";
    bar.setPointerCapture(event.pointerId);
    state.drag = { name, at: timeAt(event), x: event.clientX, isMoved: false, ...visibleWindow(state, name) };
  });
  bar.addEventListener("pointermove", (event) => {
    const { drag } = state;
    if (!drag || (!drag.isMoved && Math.abs(event.clientX - drag.x) < 3)) return;
    drag.isMoved = true;
    const now = timeAt(event);
    setWindow(state, drag.name === "new" ? orderedWindow(drag.at, now) : movedWindow(drag, drag.name, now - drag.at), true);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    bar.addEventListener(name, (event) => {
      const { drag } = state;
      state.drag = null;
      if (!drag) return;
      if (drag.isMoved) setWindow(state, [state.from, state.to], false);
      else if (drag.name === "new") setWindow(state, movedWindow(state, "middle", timeAt(event) - (state.from + state.to) / 2), false);
      for (const grip of findAll(`[data-grip="${drag.name}"]`, bar)) grip.focus({ preventScroll: true });
    });
  }
}

const orderedWindow = (one, other) => [Math.min(one, other), Math.max(one, other, Math.min(one, other) + LEAST_S)];
