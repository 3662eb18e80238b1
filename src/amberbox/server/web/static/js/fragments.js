// Fragments of HTML that the server renders again: fetched, and put in place of the old ones.
// The server has escaped what is in them; scripts in them never run.

import { ApiError, latestSignal, send, showError, signIn } from "./api.js";
import { find, findAll, setTextAttribute } from "./dom.js";
import { updateTimes } from "./time.js";

const ROLES = [["thead, tbody", "rowgroup"], ["tr", "row"], ["thead th", "columnheader"], ["tbody th", "rowheader"], ["td", "cell"]];

/**
 * Fetch the nodes of a fragment. Throws ApiError.
 * @param {string} path
 * @param {{signal?: AbortSignal}} [options]
 * @returns {Promise<Node[]>}
 */
export async function fetchNodes(path, { signal } = {}) {
  const response = await send(path, { signal, headers: { Accept: "text/html" } });
  if (response.redirected && new URL(response.url).pathname === "/sign-in") signIn();
  const page = new DOMParser().parseFromString(await response.text(), "text/html");
  if (response.ok) return [...page.body.childNodes];
  const what = find(".problem strong", page)?.textContent ?? response.statusText;
  throw new ApiError(what, find(".problem p", page)?.textContent ?? "", response.status);
}

/** Fetch a fragment that is one element. Throws ApiError. @returns {Promise<Element>} */
export async function fetchFragment(path, options = {}) {
  const nodes = await fetchNodes(path, options);
  return document.adoptNode(nodes.find((node) => node.nodeType === Node.ELEMENT_NODE));
}

/** Write times below an element, label the values of its tables, and show its chosen tabs. @param {ParentNode} root */
export function enhance(root = document) {
  updateTimes(root);
  labelTables(root);
  findAll(".tabs", root).forEach(showChosenTab);
}

/** Scroll tabs that are wider than the screen so that the chosen one is in sight. */
function showChosenTab(tabs) {
  const chosen = find("[aria-current], [aria-selected='true']", tabs);
  if (chosen) tabs.scrollLeft = chosen.offsetLeft - tabs.offsetLeft - (tabs.clientWidth - chosen.offsetWidth) / 2;
}

/**
 * Give each value of tables the title of its column, which the style sheet shows before it where
 * narrow screens make cards of rows. Tables with values across columns stay as they are.
 */
function labelTables(root) {
  for (const table of findAll("table.table", root)) {
    const heads = findAll("thead th", table).map(columnTitle);
    if (heads.length > 1 && !find("[colspan], [rowspan]", table)) labelTable(table, heads);
  }
}

/** Return the title of a column; "" where it is for screen readers only. */
function columnTitle(head) {
  return head.querySelector(":scope > .sr-only") ? "" : head.textContent.trim().replace(/\s+/g, " ");
}

/** Browsers forget the roles of table elements that are displayed as blocks: write them out. */
function labelTable(table, heads) {
  table.dataset.cards = "";
  table.setAttribute("role", "table");
  for (const [selector, role] of ROLES) {
    for (const part of findAll(selector, table)) part.setAttribute("role", role);
  }
  for (const row of findAll("tbody tr", table)) {
    [...row.children].forEach((cell, n) => heads[n] && setTextAttribute(cell, "data-label", heads[n]));
  }
}

/**
 * Replace an element by a fragment, unless they are equal; open `details` stay open, the focus
 * stays where it was. Returns the element that is on the page now.
 * @param {Element} old
 * @param {Element} fresh
 */
export function replaceElement(old, fresh) {
  enhance(fresh);
  for (const details of findAll("details[id][open]", old)) {
    find(`details[id="${CSS.escape(details.id)}"]`, fresh)?.setAttribute("open", "");
  }
  if (old.outerHTML === fresh.outerHTML) return old;
  const focused = focusFinder(old);
  old.replaceWith(fresh);
  focused?.(fresh)?.focus({ preventScroll: true });
  return fresh;
}

/**
 * Replace parts of an element: those inside `data-parts`, by their ids, that have changed. What was
 * entered in a form stays if the fresh part has a form of the same id, except `sent`. So do
 * boxes with `data-keep`, and how far something is scrolled.
 * @param {Element} old @param {Element} fresh @param {string} [sent] the id of a form
 */
export function placeParts(old, fresh, sent = "") {
  for (const [name, value] of Object.entries(fresh.dataset)) old.dataset[name] = value;
  const ids = new Set([...fresh.children].map((part) => part.id));
  for (const part of [...old.children]) if (!ids.has(part.id)) part.remove();
  let before = old.firstElementChild;
  for (const part of [...fresh.children]) {
    const was = [...old.children].find((other) => other.id === part.id);
    if (!was) old.insertBefore(document.adoptNode(part), before);
    else before = placePart(was, part, sent).nextElementSibling;
  }
  enhance(old);
  return old;
}

function placePart(old, fresh, sent) {
  if ("parts" in fresh.dataset && "parts" in old.dataset) return placeParts(old, fresh, sent);
  for (const form of findAll("form[id]", old)) {
    const freshForm = find(`form[id="${CSS.escape(form.id)}"]`, fresh);
    if (freshForm && form.id !== sent) copyInputs(form, freshForm);
  }
  for (const box of findAll("input[data-keep]", old)) {
    const freshBox = find(`#${CSS.escape(box.id)}`, fresh);
    if (freshBox) freshBox.checked = box.checked;
  }
  const places = findAll(".scroll", old).map(({ scrollLeft, scrollTop }) => ({ left: scrollLeft, top: scrollTop, behavior: "instant" }));
  const { activeElement } = document;
  const caret = old.contains(activeElement) && "selectionStart" in activeElement ? [activeElement.selectionStart, activeElement.selectionEnd] : null;
  const placed = replaceElement(old, fresh);
  // the feed was faster than the answer: what was entered, and is sent now, is not in the markup
  if (placed === old) findAll("form[id]", old).find((form) => form.id === sent)?.reset();
  findAll(".scroll", placed).forEach((scroll, n) => places[n] && scroll.scrollTo(places[n]));
  if (caret && caret[0] !== null) document.activeElement.setSelectionRange?.(...caret);
  return placed;
}

/** Copy the values of fields to those of a fresh form; true if one differs from its default. */
export function copyInputs(from, to) {
  let isUsed = false;
  for (const [k, field] of [...from.elements].entries()) {
    const counterpart = to.elements[k];
    if (!counterpart || counterpart.name !== field.name || field.tagName === "BUTTON" || field.type === "hidden") continue;
    const isBox = field.type === "radio" || field.type === "checkbox";
    isUsed ||= field.value !== field.defaultValue && "defaultValue" in field && !isBox;
    if (isBox) counterpart.checked = field.checked;
    else if (field.tagName !== "FIELDSET") counterpart.value = field.value;
  }
  return isUsed;
}

/** Replace what is inside an element; the focus stays where it was. */
export function replaceContent(place, nodes) {
  const focused = focusFinder(place);
  place.replaceChildren(...nodes);
  enhance(place);
  if (focused) (focused(place) ?? find("[tabindex]", place) ?? place).focus({ preventScroll: true });
}

/**
 * Return a function that fetches a fragment and puts it in place; a new call aborts the one before.
 * Errors are shown as toasts.
 * @param {() => Element | null} target
 * @param {() => string} address
 * @param {(fresh: Element) => void} placed
 */
export function latestFragment(target, address, placed) {
  const nextSignal = latestSignal();
  return async () => {
    try {
      const fresh = await fetchFragment(address(), { signal: nextSignal() });
      const old = target();
      if (old) placed(replaceElement(old, fresh));
    } catch (error) {
      if (error.name !== "AbortError") showError(error, null);
    }
  };
}

/**
 * Return a function that refreshes a fragment: at once, then at most once in `intervalMs`. It
 * returns whether it does so at once. `placed` is called with what came; errors are ignored.
 * @param {() => Element | null} target
 * @param {() => string} address
 * @param {number} [intervalMs]
 * @param {(fresh: Element) => void} [placed]
 * @param {(old: Element, fresh: Element) => Element} [place]
 */
export function throttledFragment(target, address, intervalMs = 1000, placed = () => {}, place = replaceElement) {
  let timer = null;
  let isRequested = false;

  async function load() {
    isRequested = false;
    timer = setTimeout(afterPause, intervalMs);
    if (!target()) return;
    const path = address();
    const fresh = await fetchFragment(path).catch(() => null); // the feed tells when the server is back
    const old = target();
    if (fresh && old && path === address()) placed(place(old, fresh)); // else another view was chosen meanwhile
  }

  function afterPause() {
    timer = null;
    if (isRequested) load();
  }

  return () => {
    isRequested = true;
    const isFree = timer === null;
    if (isFree) load();
    return isFree;
  };
}

/**
 * Return a function that finds the counterpart of the focused element in another root: by id, name
 * or link, else by position. Null where the focus is not in `root`.
 */
function focusFinder(root) {
  const element = document.activeElement;
  if (!root.contains(element)) return null;
  const selector = focusSelector(element);
  if (selector) return (other) => find(selector, other);
  const steps = [];
  for (let at = element; at !== root; at = at.parentElement) steps.unshift([...at.parentElement.children].indexOf(at));
  return (other) => steps.reduce((at, step) => at?.children[step], other);
}

function focusSelector(element) {
  const selector = (attribute, value) => `[${attribute}="${CSS.escape(value)}"]`;
  if (element.id) return selector("id", element.id);
  if (element.dataset.focus) return selector("data-focus", element.dataset.focus);
  if (element.name) return selector("name", element.name) + (element.value && element.tagName === "BUTTON" ? selector("value", element.value) : "");
  const href = element.getAttribute("href");
  return href ? selector("href", href) : null;
}
