/**
 * Where variables are drawn: over time, one against another, how often which values came, or two
 * missions over each other. One way at a time; what changes is changed in place.
 *
 * @typedef {{name: string, plot: number, variable: import("./variablelist.js").Variable}} Chosen
 * @typedef {object} Scene
 * @property {string} robot @property {Chosen[]} chosen @property {import("./view.js").Look} look
 * @property {{from: number, to: number}} window seconds @property {{from: number, to: number}} whole
 * @property {any[]} missions the two that are compared
 * @property {import("./variablelist.js").Item[]} items all that one can choose from
 */

import { fail } from "../ask.js";
import { el } from "../dom.js";
import { histogram } from "../plot/histogram.js";
import { plots } from "../plot/plot.js";
import { maybeSeconds, seconds } from "../plot/data.js";
import { moment } from "../plot/time.js";
import { t } from "../strings.js";
import { nowMs, span } from "../time.js";
import { find, isNumber } from "./variablelist.js";
import { droppedAddress, isVariable } from "./variables.js";
import { xyView } from "../plot/xy.js";

const CHECK_MS = 60;
const PATIENCE_MS = 2000;

/**
 * Make the stage inside an element.
 * @param {HTMLElement} element
 * @param {{onWindow: function(number, number): void, onRemove: function(string): void,
 *   onLive: function(string): void, onEmpty: function(boolean): void, onMoved: function(): void,
 *   onDrop: function(string, number): void, onAxes: function(string, string): void}} to
 */
export function stage(element, to) {
  let key = "";
  let way = null;

  /** @param {Scene} scene */
  function show(scene) {
    const next = scene.look.compare.length ? `compare ${scene.look.compare.join(" ")}` : scene.look.mode;
    if (next !== key) {
      way?.destroy();
      element.replaceChildren();
      way = (scene.look.compare.length ? compared : WAYS[next])(element, scene, to);
      key = next;
    }
    way.show(scene);
  }

  return { show, plots: () => way?.stack ?? null };
}

/** Wait for the first plot: people look for it before the server is to do anything else. */
export function drawn(element) {
  return new Promise((done) => {
    element.addEventListener("plotdrawn", done, { once: true });
    setTimeout(done, PATIENCE_MS);
  });
}

const WAYS = { time: overTime, xy: oneAgainstAnother, hist: howOften };

/** What `plots` needs to know of a variable. @param {string} robot @param {Chosen} chosen */
function traceOf(robot, { name, plot, variable }) {
  const { item, unit, labels, kind } = variable;
  return { id: name, robot, item, variable: variable.name, label: name, unit, labels, kind, plot };
}

function overTime(element, { robot, window, whole }, to) {
  let isOwn = false;
  const onWindow = (...moved) => isOwn || to.onWindow(...moved);
  const stack = plots(element, { ...window, whole, onWindow, onRemove: to.onRemove, onLive: to.onLive });
  stack.watch(robot);
  const placed = placing(stack);
  const end = new AbortController();
  element.addEventListener("plotdrawn", () => setTimeout(() => check(stack, to), CHECK_MS), { signal: end.signal });
  takeDrops(element, placed, to, end.signal);
  return {
    stack,
    show(scene) {
      stack.setWhole(scene.whole);
      isOwn = true;
      stack.window(scene.window.from, scene.window.to);
      isOwn = false;
      placed.show(scene.chosen.map((one) => traceOf(robot, one)));
    },
    destroy() {
      end.abort();
      stack.destroy();
    },
  };
}

/**
 * Add, move and take away what has changed. A plot stays where it is while one of its variables is
 * shown, whatever its number is then; `order` are the plots as they stand.
 */
function placing(stack) {
  const shown = new Map();
  const order = [];
  let made = 0;

  function drop(id) {
    const { panel } = shown.get(id);
    stack.remove(id);
    shown.delete(id);
    if (![...shown.values()].some((one) => one.panel === panel)) order.splice(order.findIndex((one) => one.panel === panel), 1);
  }

  /** Find for each plot the one that stands already: that of the first of its variables. */
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

/** Let variables be dropped onto plots, or beside them for a plot of their own (0). */
function takeDrops(element, { order }, to, signal) {
  const panels = () => [...element.querySelectorAll(".plot-panel")];
  const mark = (panel) => panels().forEach((one) => one.classList.toggle("data-drop", one === panel));
  element.addEventListener("dragover", (event) => {
    if (!isVariable(event)) return;
    event.preventDefault();
    mark(event.target.closest(".plot-panel"));
  }, { signal });
  element.addEventListener("dragleave", (event) => {
    if (!element.contains(event.relatedTarget)) mark(null);
  }, { signal });
  element.addEventListener("drop", (event) => {
    if (!isVariable(event)) return;
    event.preventDefault();
    const panel = event.target.closest(".plot-panel");
    mark(null);
    to.onDrop(droppedAddress(event), panel ? order[panels().indexOf(panel)].plot : 0);
  }, { signal });
}

/** Say whether the window has no value of any variable, once all have come. */
function check(stack, to) {
  const { from, to: until, traces } = stack.now();
  to.onMoved();
  if (!traces.length || !traces.every((trace) => trace.series)) return;
  const within = ({ series, live }) => [series, live].some((one) => one?.x.some((time) => time >= from && time <= until));
  to.onEmpty(!traces.some(within));
}

function compared(element, { robot, missions }) {
  const begins = missions.map((one) => seconds(one.from));
  const lengths = missions.map((one, n) => (maybeSeconds(one.to) ?? nowMs() / 1000) - begins[n]);
  const whole = { from: 0, to: Math.max(...lengths) };
  const stack = plots(element, { ...whole, whole, relative: true, fixed: true });
  const placed = placing(stack);
  const tracesOf = (one) => missions.map((mission, n) => ({
    ...traceOf(robot, one), id: `${one.name} ${mission.id}`, origin: begins[n], length: lengths[n],
    label: t("data.compare.label", { name: one.name, mission: mission.name, at: moment(begins[n], 60), length: span(lengths[n]) }),
  }));
  return { stack, show: ({ chosen }) => placed.show(chosen.flatMap(tracesOf)), destroy: stack.destroy };
}

/** Show one view and fill it with another window as it comes; what went wrong is said beside it. */
function following(element, make) {
  let view = null;
  let last = "";
  return {
    show(key, { from, to }) {
      if (key !== last) {
        view?.destroy();
        view = make({ from, to });
        last = key;
        view.ready.catch((error) => said(error, element));
      } else view.update(from, to).catch((error) => said(error, element));
    },
    destroy: () => view?.destroy(),
  };
}

function said(error, element) {
  if (error.name !== "AbortError") fail(error, element);
}

function oneAgainstAnother(element, { robot, items }, to) {
  const place = el("div");
  const [x, y] = ["x", "y"].map((name) => el("select", { name }));
  const field = (name, select) => el("label", { class: "field inline" }, el("span", {}, t(`data.xy.${name}`)), select);
  const bar = el("div", { class: "toolbar data-axes no-print" }, field("x", x), field("y", y));
  const few = el("p", { class: "notice" }, t("data.xy.two"));
  element.append(bar, few, place);
  bar.addEventListener("change", () => to.onAxes(x.value, y.value));
  let shown = null;
  let offered = null;
  return {
    show({ chosen, look, window }) {
      const used = chosen.map((one) => one.variable).filter(isNumber);
      const pair = pairOf(items, used, look);
      const offers = used.map((one) => one.address).join("\n");
      if (offers !== offered) for (const select of [x, y]) offer(select, items, used);
      offered = offers;
      [x, y].forEach((select, n) => (select.value = pair[n]?.address ?? ""));
      place.hidden = !pair.every(Boolean);
      few.hidden = !place.hidden;
      if (place.hidden) return;
      const key = pair.map((one) => one.address).join("\n");
      if (shown?.key !== key) {
        shown?.view.destroy();
        place.replaceChildren();
        const [across, up] = pair.map((variable) => traceOf(robot, { name: variable.address, plot: 1, variable }));
        shown = { key, view: following(place, (span) => xyView(place, { x: across, y: up, ...span })) };
      }
      shown.view.show(key, window);
    },
    destroy: () => shown?.view.destroy(),
  };
}

/** What is drawn across and up: what the address names, else the first of those that are shown. */
function pairOf(items, used, look) {
  const [x, y] = [look.x, look.y].map((name) => find(items, name)).map((one) => (one && isNumber(one) ? one : null));
  const first = x ?? used.find((one) => one !== y) ?? null;
  return [first, y ?? used.find((one) => one !== first) ?? null];
}

/** Offer all variables with numbers, first those that are shown. */
function offer(select, items, used) {
  const options = (variables) => variables.map(({ address }) => el("option", { value: address }, address));
  const others = items.map((item) => ({ name: item.name, variables: item.variables.filter((one) => isNumber(one) && !used.includes(one)) }));
  select.replaceChildren(el("option", { value: "" }, t("data.xy.choose")),
    ...(used.length ? [el("optgroup", { label: t("data.xy.shown") }, ...options(used))] : []),
    ...others.filter(({ variables }) => variables.length).map(({ name, variables }) => el("optgroup", { label: name }, ...options(variables))));
}

function howOften(element, { robot }) {
  const few = el("p", { class: "notice" }, t("data.hist.none"));
  const bars = el("div", { class: "data-bars" });
  element.append(few, bars);
  const shown = new Map();

  function drop(name) {
    const { place, view } = shown.get(name);
    view.destroy();
    place.remove();
    shown.delete(name);
  }
  return {
    show({ chosen, window }) {
      const numbers = chosen.filter((one) => isNumber(one.variable));
      few.hidden = numbers.length > 0 || !chosen.length;
      for (const name of [...shown.keys()]) if (!numbers.some((one) => one.name === name)) drop(name);
      for (const one of numbers) {
        if (!shown.has(one.name)) {
          const place = el("div");
          bars.append(place);
          shown.set(one.name, { place, view: following(place, (span) => histogram(place, { trace: traceOf(robot, one), ...span })) });
        }
        shown.get(one.name).view.show(one.name, window);
      }
    },
    destroy: () => [...shown.keys()].forEach(drop),
  };
}
