// The card of a diagnosis, wherever it stands: explained, answered, and renewed in its place.

import { fail, toast } from "../ask.js";
import { one, setText } from "../dom.js";
import { pieces, replace } from "../pieces.js";
import { t } from "../strings.js";

/** So long after trouble went one knows that nothing of it is seen any more. */
export const SETTLED_MS = 12000;

/**
 * Keep the card of a place up to date. Returns `renew()`, which asks for it anew.
 * @param {HTMLElement} place what the card stands in
 * @param {{path: () => string, feed?: {on: Function} | null, renewed?: (() => void) | null, robot: string}} about
 */
export function keep(place, { path, feed = null, renewed = null, robot }) {
  let asking = new AbortController();
  const leads = one("[data-link]", place) !== null;
  const linked = (address) => (leads ? `${address}${address.includes("?") ? "&" : "?"}link=1` : address);

  async function renew() {
    asking.abort();
    asking = new AbortController();
    place.setAttribute("aria-busy", "true");
    try {
      replace(place, await pieces(linked(path()), { signal: asking.signal }));
      place.removeAttribute("aria-busy");
      renewed?.();
    } catch (error) {
      if (error.name === "AbortError") return;
      place.removeAttribute("aria-busy");
      fail(error, place);
    }
  }

  place.addEventListener("done", async ({ target }) => {
    if (!target.closest("[data-answers]")) return;
    tell(target, "diagnosis.kept");
    await renew();
    toast(t("diagnosis.anew"));
  });
  place.addEventListener("refused", ({ target }) => {
    const said = sentOf(target);
    if (said) said.hidden = true;
  });
  place.addEventListener("click", ({ target }) => {
    if (target.closest("[data-again]")) renew();
    const answer = target.closest("[data-answers] [data-post]");
    if (answer) tell(answer, "diagnosis.sent");
  });
  if (feed) follow(feed, place, robot, renew);
  if (one("[data-complete='yes']", place) === null) renew();
  return renew;
}

const sentOf = (button) => button.closest("[data-answers]")?.parentElement.querySelector("[data-sent]");

/** Say at the buttons what becomes of an answer. */
function tell(button, text) {
  const said = sentOf(button);
  if (!said) return;
  setText(said, t(text, { answer: button.textContent.trim() }));
  said.hidden = false;
}

/** Renew at each diagnosis and after an absence, for as long as the place is on the page. */
function follow(feed, place, robot, renew) {
  let snapshots = 0;
  let settling = null;
  const ends = [
    feed.on("diagnosis", (_, of) => hear(of === robot)),
    feed.on("alarm", (_, of) => settle(of === robot)),
    feed.on("snapshot", () => hear((snapshots += 1) > 1)),
    () => removeEventListener("statuschange", restate),
  ];
  addEventListener("statuschange", restate);

  /** The robot's status is another one: the card says what follows from it. */
  function restate() {
    hear(true);
  }

  /** What an alarm is about may have gone: nothing else tells that nothing of it is seen. */
  function settle(isNews) {
    if (!isNews) return;
    clearTimeout(settling);
    settling = setTimeout(() => hear(true), SETTLED_MS);
  }

  function hear(isNews) {
    if (!place.isConnected) ends.forEach((end) => end());
    else if (isNews) renew();
  }
}
