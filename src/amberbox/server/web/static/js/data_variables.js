// The variables of a robot: loading, finding and choosing them.

import { requestColumns, requestJson, robotApi } from "./api.js";
import { breakableName, el, find, findAll, icon, setText, svg } from "./dom.js";
import { kindOf } from "./plot/series.js";
import { t } from "./strings.js";
import { stampToSeconds } from "./time.js";

/**
 * @typedef {object} Variable
 * @property {string} address ITEM.NAME @property {string} item @property {string} name
 * @property {string} path @property {string} type @property {string} unit
 * @property {Record<string, string>} labels
 * @property {?("number"|"enum"|"bool"|"text")} kind how it is drawn; null for what cannot be drawn
 * @property {string} words text that is searched
 *
 * @typedef {{name: string, topic: string, type: string, rate: ?number, rows: number, last: ?number,
 *   first: ?number, isOwn: boolean, chosen: string[], variables: Variable[]}} Item
 */

const NOT_DRAWABLE = /^(list<|binary|time$|duration$)/;
const INTERESTING = [/charge|soc\b|percent/i, /volt|battery/i, /wheel|odom|velocity|twist_linear_x|speed/i, /temperature|current/i];
const UNINTERESTING = /^(timestamp|received|stamp|seq|index)$|stamp_|_stamp$|(^|_)(header|frame_id)(_|$)/i;
const OWN_SOURCE = "amberbox";

/** Load all items of a robot with their variables. @returns {Promise<Item[]>} */
export async function loadItems(robot) {
  const answer = await requestJson(`/robots/${encodeURIComponent(robot)}/data/variables`);
  return answer.map(itemOf);
}

function itemOf(answer) {
  const { name, topic, type, rows, chosen } = answer;
  const all = answer.columns.map((column) => variableOf(answer, column));
  const variables = [...all.filter((variable) => !UNINTERESTING.test(variable.name)), ...all.filter((variable) => UNINTERESTING.test(variable.name))];
  return { name, topic, type, rows, chosen, variables, rate: answer.rate_hz, isOwn: answer.source === OWN_SOURCE,
    first: stampToSeconds(answer.first), last: stampToSeconds(answer.last) };
}

function variableOf(item, column) {
  const { name, path, type, unit, labels } = column;
  const words = [item.name, item.topic, item.type, name, path, type, unit, ...Object.values(labels)];
  return { address: `${item.name}.${name}`, item: item.name, name, path, type, unit, labels,
    kind: NOT_DRAWABLE.test(type) ? null : kindOf(column), words: words.join(" ").toLowerCase() };
}

/**
 * Find a variable by its address: ITEM.COLUMN, ITEM.PATH, or the unique end of a path. An ITEM alone
 * stands for the first of its variables that can be drawn.
 * @param {Item[]} items @param {string} address @returns {?Variable}
 */
export function findVariable(items, address) {
  const low = address.toLowerCase();
  const whole = items.find((item) => item.name.toLowerCase() === low);
  if (whole) return whole.variables.find((variable) => variable.kind && variable.name !== "timestamp") ?? null;
  const fitting = items.filter((item) => low.startsWith(`${item.name.toLowerCase()}.`))
    .sort((variable, other) => other.name.length - variable.name.length);
  for (const item of fitting) {
    const answer = findByName(item.variables, low.slice(item.name.length + 1));
    if (answer) return answer;
  }
  return null;
}

function findByName(variables, name) {
  const normalise = (text) => text.toLowerCase().replaceAll(/[./]/g, "_");
  const exact = variables.find((variable) => variable.name.toLowerCase() === name) ?? variables.find((variable) => normalise(variable.path) === normalise(name));
  if (exact) return exact;
  const ends = variables.filter((variable) => normalise(variable.path).endsWith(`_${normalise(name)}`));
  return ends.length === 1 ? ends[0] : null;
}

/**
 * Return the items with the variables that contain all words.
 * @param {Item[]} items @param {string} text @returns {Item[]}
 */
function searchItems(items, text) {
  const words = text.toLowerCase().split(/\s+/).filter(Boolean);
  const fits = (variable) => words.every((word) => variable.words.includes(word));
  return items.map((item) => ({ ...item, variables: item.variables.filter(fits) }))
    .filter((item) => item.variables.length);
}

/** Tell whether a variable has numbers, named ones included. @param {Variable} variable */
export const isNumeric = ({ kind }) => Boolean(kind) && kind !== "text";

/** Suggest variables to begin with. @param {Item[]} items @returns {Variable[]} */
export function suggestVariables(items, most = 6) {
  const drawable = items.filter((item) => !item.isOwn).flatMap((item) => item.variables)
    .filter((variable) => variable.kind && !UNINTERESTING.test(variable.name));
  const chosen = items.flatMap((item) => item.variables.filter((variable) => item.chosen.includes(variable.name) && variable.kind));
  const interesting = INTERESTING.flatMap((words) => drawable.filter((variable) => words.test(variable.address)).slice(0, 2));
  return [...new Set([...interesting, ...chosen, ...drawable])].slice(0, most);
}

/** Return the times of the first and the last row of a robot; null without any. @param {Item[]} items */
export function timeRange(items) {
  const pick = (name, best) => {
    const times = items.map((item) => item[name]).filter((time) => time !== null);
    return times.length ? best(...times) : null;
  };
  return { first: pick("first", Math.min), last: pick("last", Math.max) };
}

const MOST_RECENT = 8;
const storageKey = (robot) => `variables of ${robot}`;

/** Return the variables that this browser showed before, the newest first. @returns {string[]} */
export function recentVariables(robot) {
  try {
    const stored = JSON.parse(localStorage.getItem(storageKey(robot)) ?? "[]");
    return Array.isArray(stored) ? stored.filter((name) => typeof name === "string") : [];
  } catch {
    return []; // without storage nothing is suggested
  }
}

/** Remember variables that were shown. @param {string} robot @param {string[]} names */
export function rememberVariables(robot, names) {
  if (!names.length) return;
  const all = [...new Set([...names, ...recentVariables(robot)])].slice(0, MOST_RECENT);
  try {
    localStorage.setItem(storageKey(robot), JSON.stringify(all));
  } catch {
    // without storage nothing is suggested
  }
}

const SPARK_POINTS = 60;
const SPARKS_AT_ONCE = 40;
const SPARK_PAUSE_MS = 150;
const SPARK_WIDTH = 60;
const SPARK_HEIGHT = 16;
const SPARK_MARGIN = 1.5;

/** Make the place of a sparkline: all values of a variable in a tiny line. @param {Variable} variable */
function sparkPlace(variable) {
  return svg("svg", { class: "spark", viewBox: `0 0 ${SPARK_WIDTH} ${SPARK_HEIGHT}`, preserveAspectRatio: "none",
    "aria-hidden": "true", "data-spark": variable.address }, svg("path"));
}

/**
 * Draw sparklines as they become visible, with one request for variables of one item. Returns a
 * function that watches an element with the place of one.
 * @param {string} robot @param {function(string): ?Variable} variableAt
 */
function sparklineLoader(robot, variableAt) {
  const cache = new Map();
  const waiting = new Map();
  let timer = 0;
  const watcher = new IntersectionObserver((seen) => {
    for (const { isIntersecting, target } of seen) if (isIntersecting) onVisible(target);
  });

  function onVisible(element) {
    watcher.unobserve(element);
    const place = find("[data-spark]", element);
    const variable = variableAt(place.dataset.spark);
    if (!variable || variable.kind === "text" || !variable.kind) return;
    if (cache.has(variable.address)) {
      drawSpark(place, cache.get(variable.address));
      return;
    }
    waiting.set(place, variable);
    timer ||= setTimeout(load, SPARK_PAUSE_MS);
  }

  async function load() {
    timer = 0;
    const groups = Map.groupBy([...waiting], ([, variable]) => variable.item);
    waiting.clear();
    for (const [item, group] of groups) {
      for (let n = 0; n < group.length; n += SPARKS_AT_ONCE) await loadSome(item, group.slice(n, n + SPARKS_AT_ONCE));
    }
  }

  async function loadSome(item, group) {
    const query = new URLSearchParams({ item, points: SPARK_POINTS, format: "plot" });
    for (const [, variable] of group) query.append("variables", variable.name);
    const answer = await requestColumns(`${robotApi(robot)}/query?${query}`).catch(() => null);
    if (!answer) return; // a missing sparkline is worth no message
    for (const [place, variable] of group) {
      const line = sparkPath(answer, variable.name);
      cache.set(variable.address, line);
      drawSpark(place, line);
    }
  }

  return (element) => watcher.observe(element);
}

/** Return the SVG path of one column. */
function sparkPath({ header, columns }, name) {
  const at = header.columns.findIndex((column) => column.name === name || column.name === `${name}:mean`);
  const [times, values] = [columns[0], columns[at + 1]];
  if (at < 0 || !times.length) return "";
  const finite = values.filter((value) => Number.isFinite(value));
  const [low, high] = [finite.reduce((a, b) => Math.min(a, b), Infinity), finite.reduce((a, b) => Math.max(a, b), -Infinity)];
  const [begin, length] = [times[0], times[times.length - 1] - times[0] || 1];
  const y = (value) => (high > low ? SPARK_HEIGHT - SPARK_MARGIN - ((value - low) / (high - low)) * (SPARK_HEIGHT - 2 * SPARK_MARGIN) : SPARK_HEIGHT / 2);
  let pen = "M";
  let path = "";
  for (let n = 0; n < times.length; n++) {
    if (Number.isFinite(values[n])) path += `${pen}${(((times[n] - begin) / length) * SPARK_WIDTH).toFixed(1)} ${y(values[n]).toFixed(1)}`;
    pen = Number.isFinite(values[n]) ? "L" : "M";
  }
  return path;
}

function drawSpark(place, line) {
  if (line) place.firstChild.setAttribute("d", line);
}

const MOST_LEAVES = 300;
const DRAG_TYPE = "text/x-variable";

/**
 * Show the tree of variables inside an element: first shortcuts, then all by item. Checking one
 * shows it; the keys are those of trees, Space checks.
 * @param {HTMLElement} element
 * @param {{robot: string, items: Item[], open?: string,
 *   first: {id: string, title: string, addresses: string[]}[], toggle: function(string): void}} options
 */
export function variableTree(element, options) {
  const byAddress = new Map(options.items.flatMap((item) => item.variables).map((variable) => [variable.address, variable]));
  const watchSparkline = sparklineLoader(options.robot, (address) => byAddress.get(address));
  const state = { options, watchSparkline, words: "", opened: new Set([...options.first.map(({ id }) => id), options.open].filter(Boolean)),
    checked: new Set() };
  const root = el("ul", { class: "tree", role: "tree", "aria-label": t("data.tree.label"), "aria-multiselectable": "true" });
  const note = el("p", { class: "small muted", role: "status" });
  element.replaceChildren(root, note);
  root.addEventListener("click", (event) => onTreeClick(state, event));
  root.addEventListener("keydown", (event) => onTreeKey(state, root, event));
  root.addEventListener("dragstart", (event) => {
    const leaf = event.target.closest("[data-address]");
    if (leaf) startVariableDrag(event, leaf.dataset.address);
  });

  function render() {
    const focused = document.activeElement?.closest?.("[data-node]")?.dataset.node;
    const branches = state.words ? searchItems(options.items, state.words).map((item) => ({ ...itemBranch(item), isFound: true })) : [...shortcutBranches(state), ...options.items.map((item) => itemBranch(item))];
    root.replaceChildren(...branches.map((branch) => branchElement(state, branch)));
    setText(note, resultNote(state, branches));
    focusItem(root, focused && find(`[data-node="${CSS.escape(focused)}"]`, root), Boolean(focused));
  }

  render();
  return {
    /** Show only variables that contain some words. @param {string} words */
    search(words) {
      state.words = words.trim();
      render();
    },
    /** Check exactly these. @param {string[]} addresses */
    check(addresses) {
      state.checked = new Set(addresses);
      for (const leaf of findAll("[data-address]", root)) {
        leaf.setAttribute("aria-checked", String(state.checked.has(leaf.dataset.address)));
      }
    },
  };
}

/** Return the address of a dropped variable. @param {DragEvent} event */
export const droppedAddress = (event) => event.dataTransfer.getData(DRAG_TYPE);

/** Tell whether a variable is being dragged. */
export const isVariableDrag = (event) => event.dataTransfer.types.includes(DRAG_TYPE);

/** Begin to drag a variable. */
function startVariableDrag(event, address) {
  event.dataTransfer.setData(DRAG_TYPE, address);
  event.dataTransfer.effectAllowed = "copyMove";
}

function* shortcutBranches({ options }) {
  for (const { id, title, addresses } of options.first) {
    const variables = addresses.map((address) => findVariable(options.items, address)).filter(Boolean);
    if (variables.length) yield { id, title, note: "", variables, isMixed: true };
  }
}

function itemBranch(item) {
  const rate = item.rate ? t("data.tree.rate", { n: item.rate >= 10 ? Math.round(item.rate) : Number(item.rate.toPrecision(2)) }) : "";
  const title = [item.topic, item.type, t("data.tree.rows", { n: item.rows.toLocaleString("en") })].filter(Boolean).join(" · ");
  return { id: `item:${item.name}`, title: item.name, note: rate, help: title, variables: item.variables, isMixed: false };
}

function resultNote({ words }, branches) {
  if (!words) return "";
  const n = branches.reduce((sum, branch) => sum + branch.variables.length, 0);
  return n ? t(n > MOST_LEAVES ? "data.tree.too_many" : "data.tree.found", { n }) : t("data.tree.none");
}

function branchElement(state, branch) {
  const isOpen = branch.isFound || state.opened.has(branch.id);
  const label = t("data.tree.branch", { name: branch.title, n: branch.variables.length });
  const count = el("span", { class: "muted small tree-note" }, branch.note);
  const row = el("div", { class: "tree-row", title: branch.help }, icon("next"), el("span", { class: "tree-name" }, ...breakableName(branch.title)), count);
  const item = el("li", { role: "treeitem", "aria-expanded": String(isOpen), "aria-label": label, tabindex: "-1",
    "data-node": branch.id }, row);
  item.fillBranch = () => fillBranch(state, item, branch);
  if (isOpen) item.fillBranch();
  return item;
}

function fillBranch(state, item, branch) {
  if (find("ul", item)) return;
  const leaves = branch.variables.slice(0, MOST_LEAVES).map((variable) => leafElement(state, branch, variable));
  if (branch.variables.length > MOST_LEAVES) leaves.push(moreLeaf(branch));
  item.append(el("ul", { role: "group" }, ...leaves));
}

/** Make the last leaf of a branch that has too many. */
function moreLeaf({ id, variables }) {
  const text = t("data.tree.rest", { shown: MOST_LEAVES, n: variables.length });
  return el("li", { role: "treeitem", "aria-disabled": "true", tabindex: "-1", "data-node": `${id} rest` },
    el("div", { class: "tree-row muted small" }, text));
}

function leafElement(state, branch, variable) {
  const { address, kind } = variable;
  const name = branch.isMixed ? address : variable.name;
  const options = [variable.path, variable.type, variable.unit, Object.values(variable.labels).join(", ")].filter(Boolean).join(" · ");
  const label = [name, variable.unit, kind ? null : t("data.tree.undrawn")].filter(Boolean).join(", ");
  const item = el("li", { role: "treeitem", "aria-checked": kind ? String(state.checked.has(address)) : null,
    "aria-disabled": kind ? null : "true", "aria-label": label, tabindex: "-1", draggable: kind ? "true" : null,
    "data-address": kind ? address : null, "data-node": `${branch.id} ${address}` },
  el("div", { class: "tree-row", title: options }, el("span", { class: "tree-check", "aria-hidden": "true" }, icon("check")),
    el("span", { class: "tree-name" }, ...breakableName(name), variable.unit ? el("span", { class: "muted" }, ` ${variable.unit}`) : null), sparkPlace(variable)));
  if (!branch.isMixed) state.watchSparkline(item);
  return item;
}

function onTreeClick(state, event) {
  const item = event.target.closest('[role="treeitem"]');
  if (!item) return;
  activate(state, item);
  focusItem(item.closest('[role="tree"]'), item, true);
}

/** Open or close a branch; check or uncheck a variable. */
function activate(state, item) {
  if (item.dataset.address) state.options.toggle(item.dataset.address);
  else if (item.hasAttribute("aria-expanded")) openBranch(state, item, item.getAttribute("aria-expanded") !== "true");
}

function openBranch(state, item, isOpen) {
  item.setAttribute("aria-expanded", String(isOpen));
  if (isOpen) item.fillBranch();
  state.opened[isOpen ? "add" : "delete"](item.dataset.node);
}

const visibleItems = (root) => findAll('[role="treeitem"]', root)
  .filter((item) => !item.parentElement.closest('[aria-expanded="false"]'));

/** Actions of keys; each returns the item that gets the focus, or nothing. */
const TREE_KEYS = {
  ArrowDown: (_, root, item) => neighbour(root, item, 1),
  ArrowUp: (_, root, item) => neighbour(root, item, -1),
  Home: (_, root) => visibleItems(root)[0],
  End: (_, root) => visibleItems(root).at(-1),
  ArrowRight(state, root, item) {
    if (item.getAttribute("aria-expanded") === "true") return neighbour(root, item, 1);
    if (item.hasAttribute("aria-expanded")) openBranch(state, item, true);
    return item;
  },
  ArrowLeft(state, root, item) {
    if (item.getAttribute("aria-expanded") !== "true") return item.parentElement.closest('[role="treeitem"]') ?? item;
    openBranch(state, item, false);
    return item;
  },
  Enter: (state, _, item) => activate(state, item) ?? item,
  " ": (state, _, item) => activate(state, item) ?? item,
};

function onTreeKey(state, root, event) {
  const item = event.target.closest('[role="treeitem"]');
  if (!item || !TREE_KEYS[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
  event.preventDefault();
  focusItem(root, TREE_KEYS[event.key](state, root, item), true);
}

function neighbour(root, item, by) {
  const items = visibleItems(root);
  return items[Math.min(Math.max(items.indexOf(item) + by, 0), items.length - 1)];
}

/** Let Tab lead to one item only, and focus it if the focus is in the tree. */
function focusItem(root, item, withFocus) {
  const chosen = item ?? visibleItems(root)[0];
  for (const other of findAll('[tabindex="0"]', root)) other.tabIndex = -1;
  if (!chosen) return;
  chosen.tabIndex = 0;
  if (withFocus && item) chosen.focus();
}

const MOST_PLOTS = 12;

/**
 * Show the list of shown variables inside an element, to move them between plots and to remove them.
 * @param {HTMLElement} element
 * @param {{move: function(string, number): void, remove: function(string): void}} actions
 */
export function shownVariables(element, { move, remove }) {
  element.addEventListener("change", (event) => {
    const { name } = event.target.closest("[data-name]").dataset;
    move(name, Number(event.target.value));
  });
  element.addEventListener("click", (event) => {
    const button = event.target.closest("button[data-remove]");
    if (button) remove(button.closest("[data-name]").dataset.name);
  });
  element.addEventListener("dragstart", (event) => startVariableDrag(event, event.target.dataset.name));

  /** @param {import("./data.js").Named[]} named @param {function(string): string} unitOf */
  function show(named, unitOf) {
    const focused = document.activeElement?.closest?.("[data-name]");
    const focusedName = focused && element.contains(focused) ? focused.dataset.name : null;
    const most = Math.max(0, ...named.map((one) => one.plot));
    element.replaceChildren(...named.map((one) => shownRow(one, Math.min(most + 1, MOST_PLOTS), unitOf(one.name))));
    if (focusedName) element.querySelector(`[data-name="${CSS.escape(focusedName)}"] select`)?.focus();
  }
  return { show };
}

function shownRow({ name, plot }, most, unit) {
  const options = Array.from({ length: most }, (_, n) => n + 1).map((number) => el("option", {
    value: number, selected: number === plot }, t(number === most ? "data.shown.new_plot" : "data.shown.plot", { n: number })));
  return el("li", { "data-name": name, draggable: "true" },
    el("span", { class: "shown-name", title: name }, ...breakableName(name), unit ? el("span", { class: "muted" }, ` ${unit}`) : null),
    el("select", { "aria-label": t("data.shown.move", { name }) }, ...options),
    el("button", { class: "button quiet icon-only small", type: "button", "data-remove": true, "aria-label": t("data.shown.remove", { name }),
      title: t("data.shown.remove", { name }) }, icon("close")));
}
