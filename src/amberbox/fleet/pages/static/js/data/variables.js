/**
 * The tree of variables: first those of the diagnosis and those used before, then all by item.
 * Checking one shows it. Keys are those of any tree; Space checks.
 */

import { all, el, icon, one, setText } from "../dom.js";
import { breakable } from "../names.js";
import { spark, sparklines } from "./sparklines.js";
import { t } from "../strings.js";
import { find, search } from "./variablelist.js";

const MOST_SHOWN = 300;
const MIME = "text/x-variable";

/**
 * Show the tree inside an element.
 * @param {HTMLElement} element
 * @param {{robot: string, items: import("./variablelist.js").Item[], open?: string,
 *   first: {id: string, title: string, addresses: string[]}[], toggle: function(string): void}} about
 */
export function tree(element, about) {
  const known = new Map(about.items.flatMap((item) => item.variables).map((one) => [one.address, one]));
  const lines = sparklines(about.robot, (address) => known.get(address));
  const state = { about, lines, words: "", opened: new Set([...about.first.map((one) => one.id), about.open].filter(Boolean)),
    checked: new Set() };
  const root = el("ul", { class: "tree", role: "tree", "aria-label": t("data.tree.label"), "aria-multiselectable": "true" });
  const note = el("p", { class: "small muted", role: "status" });
  element.replaceChildren(root, note);
  root.addEventListener("click", (event) => clicked(state, event));
  root.addEventListener("keydown", (event) => pressed(state, root, event));
  root.addEventListener("dragstart", (event) => dragged(event));

  function fill() {
    const focused = document.activeElement?.closest?.("[data-node]")?.dataset.node;
    const branches = state.words ? found(state) : [...firsts(state), ...about.items.map((item) => ofItem(item))];
    root.replaceChildren(...branches.map((branch) => branchOf(state, branch)));
    setText(note, noteOf(state, branches));
    rove(root, focused && one(`[data-node="${CSS.escape(focused)}"]`, root), Boolean(focused));
  }

  fill();
  return {
    /** Show only what fits some words. @param {string} words */
    search(words) {
      state.words = words.trim();
      fill();
    },
    /** Check these and no others. @param {string[]} addresses */
    check(addresses) {
      state.checked = new Set(addresses);
      for (const leaf of all("[data-address]", root)) {
        leaf.setAttribute("aria-checked", String(state.checked.has(leaf.dataset.address)));
      }
    },
  };
}

/** The address that is being dragged, of a drop. @param {DragEvent} event */
export const droppedAddress = (event) => event.dataTransfer.getData(MIME);

/** Tell whether a variable is being dragged. */
export const isVariable = (event) => event.dataTransfer.types.includes(MIME);

/** Let an element be dragged as a variable. */
export function asDragged(event, address) {
  event.dataTransfer.setData(MIME, address);
  event.dataTransfer.effectAllowed = "copyMove";
}

function dragged(event) {
  const leaf = event.target.closest("[data-address]");
  if (leaf) asDragged(event, leaf.dataset.address);
}

function* firsts({ about }) {
  for (const { id, title, addresses } of about.first) {
    const variables = addresses.map((address) => find(about.items, address)).filter(Boolean);
    if (variables.length) yield { id, title, note: "", variables, isMixed: true };
  }
}

function ofItem(item) {
  const rate = item.rate ? t("data.tree.rate", { n: item.rate >= 10 ? Math.round(item.rate) : Number(item.rate.toPrecision(2)) }) : "";
  const title = [item.topic, item.type, t("data.tree.rows", { n: item.rows.toLocaleString("en") })].filter(Boolean).join(" · ");
  return { id: `item:${item.name}`, title: item.name, note: rate, help: title, variables: item.variables, isMixed: false };
}

function found({ about, words }) {
  return search(about.items, words).map((item) => ({ ...ofItem(item), isFound: true }));
}

function noteOf({ words }, branches) {
  if (!words) return "";
  const n = branches.reduce((sum, branch) => sum + branch.variables.length, 0);
  return n ? t(n > MOST_SHOWN ? "data.tree.too_many" : "data.tree.found", { n }) : t("data.tree.none");
}

function branchOf(state, branch) {
  const isOpen = branch.isFound || state.opened.has(branch.id);
  const label = t("data.tree.branch", { name: branch.title, n: branch.variables.length });
  const count = el("span", { class: "muted small tree-note" }, branch.note);
  const row = el("div", { class: "tree-row", title: branch.help }, icon("next"), el("span", { class: "tree-name" }, ...breakable(branch.title)), count);
  const item = el("li", { role: "treeitem", "aria-expanded": String(isOpen), "aria-label": label, tabindex: "-1",
    "data-node": branch.id }, row);
  item.fillBranch = () => fillBranch(state, item, branch);
  if (isOpen) item.fillBranch();
  return item;
}

function fillBranch(state, item, branch) {
  if (one("ul", item)) return;
  const leaves = branch.variables.slice(0, MOST_SHOWN).map((variable) => leafOf(state, branch, variable));
  if (branch.variables.length > MOST_SHOWN) leaves.push(restOf(branch));
  item.append(el("ul", { role: "group" }, ...leaves));
}

/** Say that there are more than one can look through. */
function restOf({ id, variables }) {
  const text = t("data.tree.rest", { shown: MOST_SHOWN, n: variables.length });
  return el("li", { role: "treeitem", "aria-disabled": "true", tabindex: "-1", "data-node": `${id} rest` },
    el("div", { class: "tree-row muted small" }, text));
}

function leafOf(state, branch, variable) {
  const { address, kind } = variable;
  const name = branch.isMixed ? address : variable.name;
  const about = [variable.path, variable.type, variable.unit, Object.values(variable.labels).join(", ")].filter(Boolean).join(" · ");
  const label = [name, variable.unit, kind ? null : t("data.tree.undrawn")].filter(Boolean).join(", ");
  const item = el("li", { role: "treeitem", "aria-checked": kind ? String(state.checked.has(address)) : null,
    "aria-disabled": kind ? null : "true", "aria-label": label, tabindex: "-1", draggable: kind ? "true" : null,
    "data-address": kind ? address : null, "data-node": `${branch.id} ${address}` },
  el("div", { class: "tree-row", title: about }, el("span", { class: "tree-check", "aria-hidden": "true" }, icon("check")),
    el("span", { class: "tree-name" }, ...breakable(name), variable.unit ? el("span", { class: "muted" }, ` ${variable.unit}`) : null), spark(variable)));
  if (!branch.isMixed) state.lines.watch(item);
  return item;
}

function clicked(state, event) {
  const item = event.target.closest('[role="treeitem"]');
  if (!item) return;
  act(state, item);
  rove(item.closest('[role="tree"]'), item, true);
}

/** Open or close a branch; check or uncheck a variable. */
function act(state, item) {
  if (item.dataset.address) state.about.toggle(item.dataset.address);
  else if (item.hasAttribute("aria-expanded")) open(state, item, item.getAttribute("aria-expanded") !== "true");
}

function open(state, item, isOpen) {
  item.setAttribute("aria-expanded", String(isOpen));
  if (isOpen) item.fillBranch();
  state.opened[isOpen ? "add" : "delete"](item.dataset.node);
}

const visible = (root) => all('[role="treeitem"]', root)
  .filter((item) => !item.parentElement.closest('[aria-expanded="false"]'));

/** What the keys do; each returns where the focus goes, or nothing. */
const KEYS = {
  ArrowDown: (_, root, item) => beside(root, item, 1),
  ArrowUp: (_, root, item) => beside(root, item, -1),
  Home: (_, root) => visible(root)[0],
  End: (_, root) => visible(root).at(-1),
  ArrowRight(state, root, item) {
    if (item.getAttribute("aria-expanded") === "true") return beside(root, item, 1);
    if (item.hasAttribute("aria-expanded")) open(state, item, true);
    return item;
  },
  ArrowLeft(state, root, item) {
    if (item.getAttribute("aria-expanded") !== "true") return item.parentElement.closest('[role="treeitem"]') ?? item;
    open(state, item, false);
    return item;
  },
  Enter: (state, _, item) => act(state, item) ?? item,
  " ": (state, _, item) => act(state, item) ?? item,
};

function pressed(state, root, event) {
  const item = event.target.closest('[role="treeitem"]');
  if (!item || !KEYS[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
  event.preventDefault();
  rove(root, KEYS[event.key](state, root, item), true);
}

function beside(root, item, by) {
  const items = visible(root);
  return items[Math.min(Math.max(items.indexOf(item) + by, 0), items.length - 1)];
}

/** Let Tab come to one item only, and put the focus there if it is in the tree already. */
function rove(root, item, withFocus) {
  const chosen = item ?? visible(root)[0];
  for (const other of all('[tabindex="0"]', root)) other.tabIndex = -1;
  if (!chosen) return;
  chosen.tabIndex = 0;
  if (withFocus && item) chosen.focus();
}
