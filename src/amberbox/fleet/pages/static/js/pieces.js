// Pieces of pages that the server makes anew: one markup, whether a page comes or changes.
// What is in them was escaped by the server; scripts in them never run.

import { AskError, fail, signIn } from "./ask.js";
import { label } from "./cards.js";
import { one } from "./dom.js";
import { t } from "./strings.js";
import { refresh } from "./time.js";

/**
 * Fetch a piece of HTML of this server: all that is in it. Throws AskError.
 * @param {string} path
 * @param {{signal?: AbortSignal}} [how]
 * @returns {Promise<Node[]>}
 */
export async function pieces(path, { signal } = {}) {
  const response = await fetched(path, signal);
  if (response.redirected && new URL(response.url).pathname === "/sign-in") signIn();
  const page = new DOMParser().parseFromString(await response.text(), "text/html");
  if (!response.ok) throw refused(page, response);
  return [...page.body.childNodes];
}

/** Fetch a piece that is one element. @returns {Promise<Element>} */
export async function piece(path, how = {}) {
  const nodes = await pieces(path, how);
  return document.adoptNode(nodes.find((node) => node.nodeType === Node.ELEMENT_NODE));
}

/**
 * Put a piece in an element's place, unless nothing changed; what was opened stays open, what had
 * the focus keeps it. Returns what is there now.
 * @param {Element} old
 * @param {Element} fresh
 */
export function put(old, fresh) {
  refresh(fresh);
  label(fresh);
  for (const details of old.querySelectorAll("details[id][open]")) {
    fresh.querySelector(`details[id="${CSS.escape(details.id)}"]`)?.setAttribute("open", "");
  }
  if (old.outerHTML === fresh.outerHTML) return old;
  const held = old.contains(document.activeElement) ? handle(old, document.activeElement) : null;
  old.replaceWith(fresh);
  if (held) held(fresh)?.focus({ preventScroll: true });
  return fresh;
}

/** Put pieces in place of what is inside an element; the focus stays on what it was on. */
export function replace(place, nodes) {
  const held = place.contains(document.activeElement) ? handle(place, document.activeElement) : null;
  place.replaceChildren(...nodes);
  refresh(place);
  label(place);
  if (held) (held(place) ?? one("[tabindex]", place) ?? place).focus({ preventScroll: true });
}

/**
 * Return what puts a piece in its place: of several questions only the last one counts. What goes
 * wrong is told beside `near`, or as a message that goes by itself.
 * @param {() => Element | null} find
 * @param {() => string} address
 * @param {{near?: () => Element | null, placed?: (fresh: Element) => void}} [more]
 */
export function swapper(find, address, { near = () => null, placed = () => {} } = {}) {
  let asked = null;
  return async function swap() {
    asked?.abort();
    const mine = (asked = new AbortController());
    try {
      const fresh = await piece(address(), { signal: mine.signal });
      const old = find();
      if (old) placed(put(old, fresh));
    } catch (error) {
      if (error.name !== "AbortError") fail(error, near());
    }
  };
}

/**
 * Make a piece stay right: `stale()` asks for it anew, at once and then at most once in `everyMs`;
 * it returns whether that is at once. `placed` is called when it came.
 * @param {() => Element | null} find
 * @param {() => string} address
 * @param {number} [everyMs]
 * @param {(fresh: Element) => void} [placed]
 */
export function keep(find, address, everyMs = 1000, placed = () => {}) {
  let timer = null;
  let isAsked = false;

  async function load() {
    isAsked = false;
    timer = setTimeout(rest, everyMs);
    if (!find()) return;
    const fresh = await piece(address()).catch(() => null); // the feed tells again when it is back
    const old = find();
    if (fresh && old) placed(put(old, fresh));
  }

  function rest() {
    timer = null;
    if (isAsked) load();
  }

  return function stale() {
    isAsked = true;
    const isFree = timer === null;
    if (isFree) load();
    return isFree;
  };
}

/** Return what finds, in another element, the one that stands for this: by its name, else by place. */
function handle(root, element) {
  const selector = named(element);
  const steps = path(root, element);
  return (other) => (selector ? one(selector, other) : steps.reduce((at, step) => at?.children[step], other));
}

function named(element) {
  const is = (attribute, value) => `[${attribute}="${CSS.escape(value)}"]`;
  if (element.id) return is("id", element.id);
  if (element.dataset.focus) return is("data-focus", element.dataset.focus);
  if (element.name) return is("name", element.name) + (element.value && element.tagName === "BUTTON" ? is("value", element.value) : "");
  const href = element.getAttribute("href");
  return href ? is("href", href) : null;
}

function path(root, element) {
  const steps = [];
  for (let at = element; at !== root; at = at.parentElement) steps.unshift([...at.parentElement.children].indexOf(at));
  return steps;
}

async function fetched(path, signal) {
  try {
    return await fetch(path, { signal, headers: { Accept: "text/html" } });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new AskError(t("common.unreachable"), t("common.unreachable_hint"), 0);
  }
}

function refused(page, response) {
  const what = one(".problem strong", page)?.textContent ?? response.statusText;
  return new AskError(what, one(".problem p", page)?.textContent ?? "", response.status);
}
