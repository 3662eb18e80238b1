// Parts of pages that the server makes: fetched, read as a document, put in place of what was there.

import { AskError, signIn } from "./ask.js";
import { one } from "./dom.js";
import { t } from "./strings.js";
import { refresh } from "./time.js";

/**
 * Fetch a part. What is in it was escaped by the server; scripts in it never run. Throws AskError.
 * @param {string} path
 * @param {{signal?: AbortSignal}} [how]
 * @returns {Promise<Node[]>}
 */
export async function fragment(path, { signal } = {}) {
  const response = await fetched(path, signal);
  if (response.redirected && new URL(response.url).pathname === "/sign-in") signIn();
  const page = new DOMParser().parseFromString(await response.text(), "text/html");
  if (!response.ok) throw refused(page, response);
  return [...page.body.childNodes];
}

/** Put a part in place of what is inside an element; the focus stays on what it was on. */
export function replace(place, nodes) {
  const held = place.contains(document.activeElement) ? handle(document.activeElement) : null;
  place.replaceChildren(...nodes);
  refresh(place);
  if (held !== null) (one(held, place) ?? one("[tabindex]", place) ?? place).focus({ preventScroll: true });
}

function handle(element) {
  const { focus } = element.dataset;
  return focus ? `[data-focus="${CSS.escape(focus)}"]` : element.name ? `[name="${CSS.escape(element.name)}"]` : "[tabindex]";
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
