// Pieces of pages that the server makes anew: one markup, whether a page comes or changes.

import { AskError, signIn } from "./ask.js";
import { t } from "./strings.js";
import { refresh } from "./time.js";

/**
 * Fetch a piece of HTML of this server: its first element. Throws AskError.
 * @param {string} path
 * @param {{signal?: AbortSignal}} [how]
 * @returns {Promise<Element>}
 */
export async function piece(path, { signal } = {}) {
  let response;
  try {
    response = await fetch(path, { signal, headers: { Accept: "text/html" } });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new AskError(t("common.unreachable"), t("common.unreachable_hint"), 0);
  }
  if (response.redirected && new URL(response.url).pathname === "/sign-in") signIn();
  const parsed = new DOMParser().parseFromString(await response.text(), "text/html");
  if (!response.ok) throw new AskError(parsed.querySelector(".problem strong")?.textContent ?? response.statusText, "", response.status);
  return document.adoptNode(parsed.body.firstElementChild);
}

/**
 * Put a piece in an element's place, unless nothing changed; what was opened stays open, what had
 * the focus keeps it. Returns what is there now.
 * @param {Element} old
 * @param {Element} fresh
 */
export function put(old, fresh) {
  refresh(fresh);
  for (const details of old.querySelectorAll("details[id][open]")) {
    fresh.querySelector(`details[id="${CSS.escape(details.id)}"]`)?.setAttribute("open", "");
  }
  if (old.outerHTML === fresh.outerHTML) return old;
  const focused = old.contains(document.activeElement) ? path(old, document.activeElement) : null;
  old.replaceWith(fresh);
  if (focused) follow(fresh, focused)?.focus({ preventScroll: true });
  return fresh;
}

/**
 * Make a piece stay right: `stale()` asks for it anew, at once and then at most once in `everyMs`.
 * `placed` is called when it came.
 * @param {() => Element | null} find
 * @param {() => string} address
 * @param {number} [everyMs]
 * @param {() => void} [placed]
 */
export function keep(find, address, everyMs = 1000, placed = () => {}) {
  let timer = null;
  let isAsked = false;

  async function load() {
    isAsked = false;
    timer = setTimeout(rest, everyMs);
    const old = find();
    if (!old) return;
    const fresh = await piece(address()).catch(() => null); // the feed tells again when it is back
    if (!fresh || !old.isConnected) return;
    put(old, fresh);
    placed();
  }

  function rest() {
    timer = null;
    if (isAsked) load();
  }

  return function stale() {
    isAsked = true;
    if (timer === null) load();
  };
}

function path(root, element) {
  const steps = [];
  for (let one = element; one !== root; one = one.parentElement) steps.unshift([...one.parentElement.children].indexOf(one));
  return steps;
}

function follow(root, steps) {
  return steps.reduce((one, step) => one?.children[step], root);
}
