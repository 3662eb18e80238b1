/**
 * The area of the data page in which variables are drawn, in one of several modes: over time, one
 * against another, as histograms, or for two missions over each other.
 *
 * @typedef {{name: string, plot: number, variable: import("./data_variables.js").Variable}} Chosen
 * @typedef {object} Scene
 * @property {string} robot @property {Chosen[]} chosen @property {import("./data.js").View} view
 * @property {{from: number, to: number}} window seconds @property {{from: number, to: number}} whole
 * @property {any[]} missions the two that are compared
 * @property {import("./data_variables.js").Item[]} items all of the robot
 */

import { showError } from "./api.js";
import { droppedAddress, findVariable, isNumeric, isVariableDrag } from "./data_variables.js";
import { el } from "./dom.js";
import { dateTime } from "./plot/axes.js";
import { histogram, xyView } from "./plot/figures.js";
import { plots } from "./plot/plot.js";
import { t } from "./strings.js";
import { durationText, nowMs, stampToSeconds } from "./time.js";

const EMPTY_CHECK_MS = 60;
const PATIENCE_MS = 2000;

/**
 * Make the plot area inside an element.
 * @param {HTMLElement} element
 * @param {{onWindow: function(number, number): void, onRemove: function(string): void,
 *   onLive: function(string): void, onEmpty: function(boolean): void, onMoved: function(): void,
 *   onDrop: function(string, number): void, onAxes: function(string, string): void}} handlers
 */
export function plotArea(element, handlers) {
  let key = "";
  let mode = null;

  /** @param {Scene} scene */
  function show(scene) {
    const next = scene.view.compare.length ? `compare ${scene.view.compare.join(" ")}` : scene.view.mode;
    if (next !== key) {
      mode?.destroy();
      element.replaceChildren();
      mode = (scene.view.compare.length ? comparisonPlots : MODES[next])(element, scene, handlers);
      key = next;
    }
    mode.show(scene);
  }

  return { show, plots: () => mode?.stack ?? null };
}

/** Wait for the first plot, which is loaded before anything else. */
export function firstPlotDrawn(element) {
  return new Promise((done) => {
    element.addEventListener("plotdrawn", done, { once: true });
    setTimeout(done, PATIENCE_MS);
  });
}

const MODES = { time: timePlots, xy: xyMode, hist: histogramMode };

/** Return the options of a variable for `plots`. @param {string} robot @param {Chosen} chosen */
function traceOptions(robot, { name, plot, variable }) {
  const { item, unit, labels, kind } = variable;
  return { id: name, robot, item, variable: variable.name, label: name, unit, labels, kind, plot };
}

function timePlots(element, { robot, window, whole }, handlers) {
  let isProgrammatic = false;
  const onWindow = (...moved) => isProgrammatic || handlers.onWindow(...moved);
  const stack = plots(element, { ...window, whole, onWindow, onRemove: handlers.onRemove, onLive: handlers.onLive });
  stack.watch(robot);
  const placement = panelPlacement(stack);
  const end = new AbortController();
  element.addEventListener("plotdrawn", () => setTimeout(() => checkEmpty(stack, handlers), EMPTY_CHECK_MS), { signal: end.signal });
  acceptDrops(element, placement, handlers, end.signal);
  return {
    stack,
    show(scene) {
      stack.setWhole(scene.whole);
      isProgrammatic = true;
      stack.window(scene.window.from, scene.window.to);
      isProgrammatic = false;
      placement.show(scene.chosen.map((one) => traceOptions(robot, one)));
    },
    destroy() {
      end.abort();
      stack.destroy();
    },
  };
}

/**
 * Assign variables to panels. A panel stays while one of its variables is shown, even if its number
 * changes; `order` lists the panels from top to bottom.
 */
function panelPlacement(stack) {
  const shown = new Map();
  const order = [];
  let made = 0;

  function drop(id) {
    const { panel } = shown.get(id);
    stack.remove(id);
    shown.delete(id);
    if (![...shown.values()].some((one) => one.panel === panel)) order.splice(order.findIndex((one) => one.panel === panel), 1);
  }

  /** Return the panel of each plot: the present one of the first of its variables, else a new one. */
  function panelsOf(traces) {
    const found = new Map();
    for (const { id, plot } of traces) {
      const panel = shown.get(id)?.panel;
      if (panel && !found.has(plot) && ![...found.values()].includes(panel)) found.set(plot, panel);
    }
    for (const { plot } of traces) if (!found.has(plot)) found.set(plot, `plot ${(made += 1)}`);
    return found;
  }

  function show(traces) {
    const panels = panelsOf(traces);
    for (const [id, was] of [...shown]) {
      const now = traces.find((one) => one.id === id);
      if (!now || panels.get(now.plot) !== was.panel) drop(id);
    }
    for (const trace of traces) {
      const panel = panels.get(trace.plot);
      if (!order.some((one) => one.panel === panel)) order.push({ panel, plot: 0 });
      order.find((one) => one.panel === panel).plot = trace.plot;
      if (!shown.has(trace.id)) stack.add({ ...trace, panel });
      shown.set(trace.id, { ...trace, panel });
    }
  }
  return { show, order };
}

/** Let variables be dropped onto plots, or beside them for a new plot (0). */
function acceptDrops(element, { order }, handlers, signal) {
  const panels = () => [...element.querySelectorAll(".plot-panel")];
  const mark = (panel) => panels().forEach((one) => one.classList.toggle("data-drop", one === panel));
  element.addEventListener("dragover", (event) => {
    if (!isVariableDrag(event)) return;
    event.preventDefault();
    mark(event.target.closest(".plot-panel"));
  }, { signal });
  element.addEventListener("dragleave", (event) => {
    if (!element.contains(event.relatedTarget)) mark(null);
  }, { signal });
  element.addEventListener("drop", (event) => {
    if (!isVariableDrag(event)) return;
    event.preventDefault();
    const panel = event.target.closest(".plot-panel");
    mark(null);
    handlers.onDrop(droppedAddress(event), panel ? order[panels().indexOf(panel)].plot : 0);
  }, { signal });
}

/** Report whether the window has no values, once all variables are loaded. */
function checkEmpty(stack, handlers) {
  const { from, to: until, traces } = stack.now();
  handlers.onMoved();
  if (!traces.length || !traces.every((trace) => trace.series)) return;
  const within = ({ series, live }) => [series, live].some((one) => one?.x.some((time) => time >= from && time <= until));
  handlers.onEmpty(!traces.some(within));
}

function comparisonPlots(element, { robot, missions }) {
  const begins = missions.map((one) => stampToSeconds(one.from));
  const lengths = missions.map((one, n) => (stampToSeconds(one.to) ?? nowMs() / 1000) - begins[n]);
  const whole = { from: 0, to: Math.max(...lengths) };
  const stack = plots(element, { ...whole, whole, relative: true, fixed: true });
  const placement = panelPlacement(stack);
  const tracesOf = (one) => missions.map((mission, n) => ({
    ...traceOptions(robot, one), id: `${one.name} ${mission.id}`, origin: begins[n], length: lengths[n],
    label: t("data.compare.label", { name: one.name, mission: mission.name, at: dateTime(begins[n], 60), length: durationText(lengths[n]) }),
  }));
  return { stack, show: ({ chosen }) => placement.show(chosen.flatMap(tracesOf)), destroy: stack.destroy };
}

/** Keep one figure in an element: a new key makes a new one, a new window updates it. */
function figureSlot(element, make) {
  let view = null;
  let last = "";
  return {
    show(key, { from, to: handlers }) {
      if (key !== last) {
        view?.destroy();
        view = make({ from, to: handlers });
        last = key;
        view.ready.catch((error) => reportError(error, element));
      } else view.update(from, handlers).catch((error) => reportError(error, element));
    },
    destroy: () => view?.destroy(),
  };
}

function reportError(error, element) {
  if (error.name !== "AbortError") showError(error, element);
}

function xyMode(element, { robot, items }, handlers) {
  const place = el("div");
  const [x, y] = ["x", "y"].map((name) => el("select", { name }));
  const field = (name, select) => el("label", { class: "field inline" }, el("span", {}, t(`data.xy.${name}`)), select);
  const bar = el("div", { class: "toolbar data-axes no-print" }, field("x", x), field("y", y));
  const hint = el("p", { class: "notice" }, t("data.xy.two"));
  element.append(bar, hint, place);
  bar.addEventListener("change", () => handlers.onAxes(x.value, y.value));
  let shown = null;
  let offered = null;
  return {
    show({ chosen, view, window }) {
      const used = chosen.map((one) => one.variable).filter(isNumeric);
      const pair = xyVariables(items, used, view);
      const offers = used.map((one) => one.address).join("\n");
      if (offers !== offered) for (const select of [x, y]) offerVariables(select, items, used);
      offered = offers;
      [x, y].forEach((select, n) => (select.value = pair[n]?.address ?? ""));
      place.hidden = !pair.every(Boolean);
      hint.hidden = !place.hidden;
      if (place.hidden) return;
      const key = pair.map((one) => one.address).join("\n");
      if (shown?.key !== key) {
        shown?.view.destroy();
        place.replaceChildren();
        const [across, up] = pair.map((variable) => traceOptions(robot, { name: variable.address, plot: 1, variable }));
        shown = { key, view: figureSlot(place, (span) => xyView(place, { x: across, y: up, ...span })) };
      }
      shown.view.show(key, window);
    },
    destroy: () => shown?.view.destroy(),
  };
}

/** Return the variables across and up: those of the address, else the first of those shown. */
function xyVariables(items, used, view) {
  const [x, y] = [view.x, view.y].map((name) => findVariable(items, name)).map((one) => (one && isNumeric(one) ? one : null));
  const first = x ?? used.find((one) => one !== y) ?? null;
  return [first, y ?? used.find((one) => one !== first) ?? null];
}

/** Offer all numeric variables, first those that are shown. */
function offerVariables(select, items, used) {
  const options = (variables) => variables.map(({ address }) => el("option", { value: address }, address));
  const others = items.map((item) => ({ name: item.name, variables: item.variables.filter((one) => isNumeric(one) && !used.includes(one)) }));
  select.replaceChildren(el("option", { value: "" }, t("data.xy.choose")),
    ...(used.length ? [el("optgroup", { label: t("data.xy.shown") }, ...options(used))] : []),
    ...others.filter(({ variables }) => variables.length).map(({ name, variables }) => el("optgroup", { label: name }, ...options(variables))));
}

function histogramMode(element, { robot }) {
  const hint = el("p", { class: "notice" }, t("data.hist.none"));
  const bars = el("div", { class: "data-bars" });
  element.append(hint, bars);
  const shown = new Map();

  function drop(name) {
    const { place, view } = shown.get(name);
    view.destroy();
    place.remove();
    shown.delete(name);
  }
  return {
    show({ chosen, window }) {
      const numbers = chosen.filter((one) => isNumeric(one.variable));
      hint.hidden = numbers.length > 0 || !chosen.length;
      for (const name of [...shown.keys()]) if (!numbers.some((one) => one.name === name)) drop(name);
      for (const one of numbers) {
        if (!shown.has(one.name)) {
          const place = el("div");
          bars.append(place);
          shown.set(one.name, { place, view: figureSlot(place, (span) => histogram(place, { trace: traceOptions(robot, one), ...span })) });
        }
        shown.get(one.name).view.show(one.name, window);
      }
    },
    destroy: () => [...shown.keys()].forEach(drop),
  };
}
