// The data page: what its address says is shown, and what people do is written into the address.

import { clearError, requestJson, robotApi, showError } from "./api.js";
import { jobList, startCompareDialog, startDownloadDialog, startMarkDialogs, startMomentMenu } from "./data_actions.js";
import { firstPlotDrawn, plotArea } from "./data_stage.js";
import { findVariable, loadItems, recentVariables, rememberVariables, shownVariables, suggestVariables, timeRange, variableTree } from "./data_variables.js";
import { loadCoverage, mayHaveMore, newestEnd, resolveView, timelineBrush, wholeRange, windowForm } from "./data_window.js";
import { el, find, icon, pageData } from "./dom.js";
import { subscribe } from "./feed.js";
import { boundedWindow } from "./plot/series.js";
import { t } from "./strings.js";
import { nowMs, secondsToStamp } from "./time.js";
import { getParam, getParams, onNavigation, setParams } from "./url.js";

/**
 * What the data page shows, as in its address. Times stay as they were written until somebody moves
 * the window, so that `now-1h` is right for everybody to whom the address is sent.
 *
 * @typedef {{plot: number, name: string}} Named a variable and the number of its plot
 * @typedef {object} View
 * @property {Named[]} named @property {string} from @property {string} to @property {boolean} live
 * @property {"time"|"xy"|"hist"} mode @property {string[]} compare ids of two missions, or none
 * @property {string} mission id of the mission that gives the window, or empty
 * @property {string} x @property {string} y variables of the XY view, empty for the first two
 */

const MODES = ["time", "xy", "hist"];
const MOST_VARIABLES = 32;

/** Read the view of the address. @returns {View} */
function readView() {
  const mode = getParam("mode", "time");
  const compare = getParam("compare").split(",").filter(Boolean);
  return {
    named: parseVariables(getParams("v").slice(0, MOST_VARIABLES)), from: getParam("from"), to: getParam("to"),
    live: getParam("live") === "1", mode: MODES.includes(mode) ? mode : "time",
    compare: compare.length === 2 ? compare : [], mission: getParam("mission"),
    x: getParam("x"), y: getParam("y"),
  };
}

/** Write a view into the address. @param {View} view */
function writeView(view, { push = false } = {}) {
  setParams({
    v: formatVariables(view.named), from: view.from, to: view.to, live: view.live ? "1" : null,
    mode: view.mode === "time" ? null : view.mode, compare: view.compare.join(","), mission: view.mission,
    x: view.mode === "xy" ? view.x : null, y: view.mode === "xy" ? view.y : null,
  }, { push });
}

/** Read variables as `2:name`: the plot before the name, else a new one. @param {string[]} texts */
function parseVariables(texts) {
  const found = texts.map((text) => {
    const parts = /^(\d{1,2}):(.+)$/.exec(text);
    return parts ? { plot: Number(parts[1]), name: parts[2] } : { plot: 0, name: text };
  });
  let last = Math.max(0, ...found.map((one) => one.plot));
  return found.map((one) => (one.plot ? one : { ...one, plot: (last += 1) }));
}

/** Write variables as `parseVariables` reads them; without plots if each has its own. */
function formatVariables(named) {
  const isPlain = named.every((one, n) => one.plot === n + 1);
  return named.map(({ plot, name }) => (isPlain ? name : `${plot}:${name}`));
}

/** Number plots from 1 without gaps, in their order. @param {Named[]} named @returns {Named[]} */
function renumberPlots(named) {
  const plots = [...new Set(named.map((one) => one.plot))].sort((one, other) => one - other);
  return named.map((one) => ({ ...one, plot: plots.indexOf(one.plot) + 1 }))
    .sort((one, other) => one.plot - other.plot);
}

/**
 * Start the notes above the plots: no values in the window, unknown names, more data on the robot,
 * which may be fetched where the element has `data-fetch`.
 * @param {HTMLElement} element
 * @param {{newest: function(): void, fetch: function(HTMLElement): void}} actions
 */
function noteList(element, actions) {
  const mayFetch = "fetch" in element.dataset;
  let last = "";

  /** @param {{isEmpty: boolean, unknown: string[], canFetch: boolean}} facts */
  function show(facts) {
    const key = JSON.stringify(facts);
    if (key === last) return;
    last = key;
    element.replaceChildren(...notesFor(facts));
  }

  function* notesFor({ isEmpty, unknown, canFetch }) {
    for (const name of unknown) yield noteElement("info", t("data.unknown", { name }));
    const offers = canFetch && mayFetch;
    if (isEmpty) yield noteElement("info", t("data.no_values"), noteButton(t("data.to_newest"), () => actions.newest()), offers ? fetchButton() : null);
    else if (canFetch) yield noteElement("upload", t(mayFetch ? "data.more_on_robot" : "data.more_on_robot_only"), offers ? fetchButton() : null);
  }

  const fetchButton = () => noteButton(t("data.ask_robot"), (event) => actions.fetch(event.target.closest(".data-note")));
  return { show };
}

/** Offer variables to begin with. @param {import("./data_variables.js").Variable[]} variables */
function showSuggestions(element, variables, toggle) {
  element.querySelector("[data-suggested]").replaceChildren(...variables.map((variable) =>
    el("li", {}, noteButton(variable.unit ? `${variable.address} ${variable.unit}` : variable.address, () => toggle(variable.address), "chart"))));
}

function noteElement(picture, text, ...buttons) {
  return el("div", { class: "notice row data-note" }, icon(picture), el("span", {}, text), ...buttons);
}

function noteButton(text, act, picture = "") {
  return el("button", { class: "button small", type: "button", onclick: act }, picture ? icon(picture) : null, el("span", { class: "clip" }, text));
}

const HOUR_S = 3600;
const RELOAD_MS = 60_000;
const FOLLOW_MS = 1000;
const GESTURE_MS = 1500;
const NARROW = "(max-width: 60rem)";
const { robot, named: fromDiagnosis } = pageData("data-about");
const apiPath = robotApi(robot);
const now = () => nowMs() / 1000;

const state = {
  view: readView(), items: [], range: { first: null, last: null }, coverage: null, window: { from: now() - HOUR_S, to: now() },
  missions: [], parts: {}, isEmpty: false, live: "off", requests: 0, movedMs: -GESTURE_MS,
};

load();

function load() {
  start().catch(showProblem);
}

/** Load the variables and show the view; without any the page tries again later. */
async function start() {
  state.items = await loadItems(robot);
  state.range = timeRange(state.items);
  const isEmpty = !state.items.length;
  find("#data-nothing").hidden = !isEmpty;
  find("#data").hidden = isEmpty;
  if (isEmpty) {
    setTimeout(load, RELOAD_MS);
    return;
  }
  buildParts();
  if (state.view.named.length && matchMedia(NARROW).matches) find("#data-side").open = false;
  await onUrlChange();
  onNavigation(onUrlChange);
  setInterval(reloadIfNewer, RELOAD_MS);
  setInterval(followLivePlots, FOLLOW_MS);
  if (chosenVariables().length && state.view.mode === "time") await firstPlotDrawn(find("#plots"));
  setCoverage(await loadCoverage(robot));
}

function showProblem(error) {
  showError(error, find("#data-problem"));
}

/** Make all parts, which show nothing yet. */
function buildParts() {
  const { parts } = state;
  parts.feed = subscribe({ robots: [robot], kinds: ["alarm", "job", "fetch"] });
  parts.stage = plotArea(find("#plots"), {
    onWindow: (from, to) => moveWindow(from, to, "plots"), onRemove: toggleVariable, onMoved: followLivePlots, onDrop,
    onEmpty: (isEmpty) => showNotes({ isEmpty }), onAxes: (x, y) => changeView({ x, y }),
    onLive(liveState) {
      state.live = liveState;
      parts.form.live(liveState);
    },
  });
  parts.brush = timelineBrush(find("#brush"), (from, to, isMoving) => moveWindow(from, to, isMoving ? "moving" : "brush"));
  parts.form = windowForm(find("#window"), {
    newest: goToNewest, go: (from, to) => moveWindow(from, to), live: (isOn) => setLive(isOn), everything: () => moveWindow(...endsOf(wholeWindow())),
    mode: (mode) => (state.view.compare.length ? requestView({ mode, compare: [] }) : changeView({ mode })),
  });
  parts.shown = shownVariables(find("#shown"), { move: (name, plot) => moveToPlot(name, plot), remove: toggleVariable });
  parts.tree = variableTree(find("#variables"), { robot, items: state.items, first: shortcuts(), toggle: toggleVariable, open: state.view.named.length ? "" : `item:${state.items[0].name}` });
  parts.notes = noteList(find("#data-notes"), { newest: goToNewest, fetch: requestFetch });
  parts.jobs = jobList(find("#works"), robot, { fetched: reloadAll });
  find("#search").addEventListener("input", (event) => parts.tree.search(event.target.value));
  startMomentMenu(find("#goto"), robot, (from, to, mission) => (mission ? requestView({ mission, from: "", to: "", live: false }) : moveWindow(from, to)));
  const about = { window: () => state.window, cursor: () => parts.stage.plots()?.now().cursor ?? null };
  startMarkDialogs(robot, { ...about, changed: reloadMarks });
  startDownloadDialog(robot, { ...about, chosen: () => chosenVariables().map((one) => one.variable), started: parts.jobs.download });
  startCompareDialog(robot, { begin: (pair) => requestView({ compare: pair, mode: "time", live: false }), end: () => requestView({ compare: [] }) });
  for (const kind of ["job", "fetch"]) parts.feed.on(kind, ({ id }) => parts.jobs.update(id));
  parts.feed.on("snapshot", () => parts.jobs.updateAll());
  parts.feed.on("alarm", reloadMarks);
}

function shortcuts() {
  return [
    { id: "diagnosis", title: find("#variables").dataset.diagnosis, addresses: fromDiagnosis },
    { id: "recent", title: find("#variables").dataset.recent, addresses: recentVariables(robot) },
  ];
}

/** Show a view. @param {View} requested */
async function showView(requested) {
  const number = (state.requests += 1);
  clearError(find("#data-problem"));
  const resolved = await resolveView(requested, apiPath, reference(), showProblem);
  if (number !== state.requests) return; // another view was requested meanwhile
  const { view } = Object.assign(state, resolved);
  if (!view.live) setLive(false, false);
  const known = view.named.map((one) => ({ ...one, name: findVariable(state.items, one.name)?.address ?? one.name }));
  const seen = new Set();
  view.named = renumberPlots(known.filter((one) => !seen.has(one.name) && seen.add(one.name)));
  rememberVariables(robot, chosenVariables().map((one) => one.name));
  show();
}

/** Change the view in a way for which the server has to be asked first. */
function requestView(changes) {
  writeView({ ...state.view, ...changes }, { push: true });
  return onUrlChange();
}

/** Show the view of the address. */
function onUrlChange() {
  return showView(readView()).catch(showProblem);
}

const chosenVariables = () => state.view.named.map((one) => ({ ...one, variable: findVariable(state.items, one.name) })).filter((one) => one.variable?.kind);
const endsOf = ({ from, to }) => [from, to];

const wholeWindow = () => wholeRange(state.coverage, state.range, state.window);
const reference = () => ({ now: now(), last: state.range.last });

/** Show the state of the page. */
function show() {
  const { view, parts } = state;
  followLivePlots();
  const scene = { robot, view, chosen: chosenVariables(), window: state.window, whole: wholeWindow(), missions: state.missions, items: state.items };
  find("#data").classList.toggle("data-comparing", view.compare.length > 0);
  find("#comparing").hidden = !view.compare.length;
  parts.stage.show(scene);
  if (view.mode === "time" && !view.compare.length) setLive(view.live, false);
  parts.tree.check(view.named.map((one) => one.name));
  parts.shown.show(view.named, (name) => findVariable(state.items, name)?.unit ?? "");
  parts.form.mode(view.mode);
  showWindow();
  showNotes({ isEmpty: false, unknown: view.named.filter((one) => !findVariable(state.items, one.name)?.kind).map((one) => one.name) });
  showSuggestions(find("#data-empty"), view.named.length ? [] : suggestions(), toggleVariable);
  const isBare = !view.named.length && view.mode !== "xy"; // XY offers all variables itself
  find("#data-empty").hidden = !isBare;
  find("#plots").hidden = isBare;
}

function suggestions() {
  const named = fromDiagnosis.map((name) => findVariable(state.items, name)).filter((one) => one?.kind);
  return [...new Set([...named, ...suggestVariables(state.items)])].slice(0, 8);
}

function showWindow() {
  const { from, to } = state.window;
  state.parts.brush.window(from, to);
  state.parts.form.window(from, to);
}

/** Change the view, in one step that "back" undoes. @param {Partial<View>} changes */
function changeView(changes) {
  Object.assign(state.view, changes);
  writeView(state.view, { push: true });
  show();
}

/** Show or hide a variable. @param {string} name */
function toggleVariable(name) {
  const { named } = state.view;
  const isShown = named.some((one) => one.name === name);
  const next = isShown ? named.filter((one) => one.name !== name) : [...named, { name, plot: Math.max(0, ...named.map((one) => one.plot)) + 1 }];
  if (!isShown) rememberVariables(robot, [name]);
  changeView({ named: renumberPlots(next) });
}

/** Move a variable to a plot; 0 is a new one. */
function moveToPlot(name, plot) {
  const rest = state.view.named.filter((one) => one.name !== name);
  const own = Math.max(0, ...state.view.named.map((one) => one.plot)) + 1;
  changeView({ named: renumberPlots([...rest, { name, plot: plot || own }]) });
}

function onDrop(name, plot) {
  rememberVariables(robot, [name]);
  moveToPlot(name, plot);
}

/** Move the window, as the user did. @param {"plots"|"brush"|"moving"} [by] */
function moveWindow(begin, end, by = "brush") {
  const { from, to } = (state.window = boundedWindow({ from: begin, to: end }));
  const stack = state.parts.stage.plots();
  if (by !== "plots" && stack && !state.view.compare.length) stack.window(from, to, { soft: by === "moving" });
  if (by === "moving") {
    state.parts.form.window(from, to);
    return;
  }
  if (state.view.compare.length) return;
  if (state.live !== "on") Object.assign(state.view, { from: secondsToStamp(from), to: secondsToStamp(to), mission: "", live: false });
  writeView(state.view, { push: isSeparateMove() });
  showWindow();
  if (!stack) show();
  showNotes({ isEmpty: false });
}

/** Tell whether a move is a step of its own: moves in quick succession are one. */
function isSeparateMove() {
  const before = state.movedMs;
  state.movedMs = performance.now();
  return state.movedMs - before > GESTURE_MS;
}

/** Go to the newest data. @param {number} [width] seconds */
function goToNewest(width = state.window.to - state.window.from) {
  const lasts = chosenVariables().map((one) => state.items.find((item) => item.name === one.variable.item)?.last).filter(Boolean);
  const end = lasts.length && state.isEmpty ? Math.max(...lasts) + width * 0.02 : newestEnd(width, reference());
  moveWindow(end - width, end);
}

/** Follow the window of the plots, which moves with live values. */
function followLivePlots() {
  const stack = state.parts.stage.plots();
  if (state.live !== "on" || !stack) return;
  const { from, to } = stack.now();
  if (to === state.window.to) return;
  state.window = { from, to };
  showWindow();
}

/** Start or stop following live values. */
function setLive(isOn, isByHand = true) {
  const stack = state.parts.stage.plots();
  if (!stack || (isOn && state.live === "on")) return;
  if (isOn && state.live === "paused") stack.follow();
  else if (isOn || state.live !== "off") stack.live(isOn ? state.parts.feed : null);
  if (!isByHand) return;
  const width = Math.round(state.window.to - state.window.from);
  if (isOn) {
    state.window = { from: now() - width, to: now() };
    stack.window(state.window.from, state.window.to, { silent: true });
    showWindow();
  }
  Object.assign(state.view, isOn ? { live: true, from: `now-${width}s`, to: "now", mission: "" }
    : { live: false, from: secondsToStamp(state.window.from), to: secondsToStamp(state.window.to) });
  writeView(state.view, { push: true });
}

/** Show the notes above the plots. */
function showNotes(changes) {
  Object.assign(state, changes);
  const { isEmpty, unknown = [], window } = state;
  state.parts.notes.show({
    isEmpty: isEmpty && state.view.mode === "time" && state.live !== "on", unknown,
    canFetch: state.coverage !== null && !state.view.compare.length && mayHaveMore(state.coverage, window, now()) && !state.parts.jobs.isFetching(),
  });
}

async function requestFetch(near) {
  const { from, to } = state.window;
  try {
    state.parts.jobs.fetch(await requestJson(`${apiPath}/fetches`, { method: "POST", body: { from: secondsToStamp(from), to: secondsToStamp(to) } }));
    showNotes({});
  } catch (error) {
    showError(error, near);
  }
}

/** Load everything again: new data have come from the robot. */
async function reloadAll() {
  setCoverage(await loadCoverage(robot));
  state.parts.stage.plots()?.refresh();
}

/** Load again if more data have come that the window shows. */
async function reloadIfNewer() {
  if (document.hidden) return;
  const before = state.coverage?.end ?? 0;
  setCoverage(await loadCoverage(robot));
  if (state.coverage?.end > before && state.window.to > before && !state.view.compare.length) state.parts.stage.plots()?.refresh();
}

/** @param {?import("./data_window.js").Coverage} coverage */
function setCoverage(coverage) {
  if (!coverage) return; // loaded again in a minute
  state.coverage = coverage;
  state.range.last = coverage.end === null ? state.range.last : Math.max(state.range.last ?? coverage.end, coverage.end);
  const { from, to } = wholeWindow();
  state.parts.brush.coverage({ ...state.coverage, start: from, end: Math.max(to, Math.min(state.window.to, now())) });
  state.parts.stage.plots()?.setWhole(state.view.compare.length ? state.parts.stage.plots().now() : { from, to });
  showNotes({});
}

/** Load the marks and lanes of the plots again. */
function reloadMarks() {
  if (!state.view.compare.length) state.parts.stage.plots()?.watch(robot);
}
