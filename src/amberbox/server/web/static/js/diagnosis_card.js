// The card of a diagnosis, on several pages: its buttons for answers, and its renewal.

import { latestSignal, showError, toast } from "./api.js";
import { find, setText } from "./dom.js";
import { fetchNodes, replaceContent } from "./fragments.js";
import { t } from "./strings.js";
import { debounce } from "./time.js";

/** After an alarm: until then its symptoms have cleared if they will. */
export const SETTLED_MS = 12000;

/**
 * Keep the card in a place current. Returns `renew()`, which loads it again.
 * @param {HTMLElement} place
 * @param {{path: () => string, feed?: {on: Function} | null, renewed?: (() => void) | null, robot: string}} options
 */
export function keepCardCurrent(place, { path, feed = null, renewed = null, robot }) {
  const nextSignal = latestSignal();
  const hasLinks = find("[data-link]", place) !== null;
  const withLinks = (address) => (hasLinks ? `${address}${address.includes("?") ? "&" : "?"}link=1` : address);

  async function renew() {
    place.setAttribute("aria-busy", "true");
    try {
      replaceContent(place, await fetchNodes(withLinks(path()), { signal: nextSignal() }));
      place.removeAttribute("aria-busy");
      renewed?.();
    } catch (error) {
      if (error.name === "AbortError") return;
      place.removeAttribute("aria-busy");
      showError(error, place);
    }
  }

  place.addEventListener("done", async ({ target }) => {
    if (!target.closest("[data-answers]")) return;
    showAnswerNote(target, "diagnosis.kept");
    await renew();
    toast(t("diagnosis.anew"));
  });
  place.addEventListener("refused", ({ target }) => {
    const note = answerNote(target);
    if (note) note.hidden = true;
  });
  place.addEventListener("click", ({ target }) => {
    if (target.closest("[data-again]")) renew();
    const answer = target.closest("[data-answers] [data-post]");
    if (answer) showAnswerNote(answer, "diagnosis.sent");
  });
  if (feed) renewOnNews(feed, place, robot, renew);
  if (find("[data-complete='yes']", place) === null) renew();
  return renew;
}

const answerNote = (button) => button.closest("[data-answers]")?.parentElement.querySelector("[data-sent]");

/** Show beside the buttons what becomes of an answer. */
function showAnswerNote(button, text) {
  const note = answerNote(button);
  if (!note) return;
  setText(note, t(text, { answer: button.textContent.trim() }));
  note.hidden = false;
}

/** Renew at each diagnosis and after a reconnection, for as long as the place is on the page. */
function renewOnNews(feed, place, robot, renew) {
  let snapshots = 0;
  const renewSettled = debounce(() => onNews(true), SETTLED_MS);
  const unsubscribers = [
    feed.on("diagnosis", (_, source) => onNews(source === robot)),
    feed.on("alarm", (_, source) => renewLater(source === robot)),
    feed.on("snapshot", () => onNews((snapshots += 1) > 1)),
    () => removeEventListener("statuschange", onStatusChange),
  ];
  addEventListener("statuschange", onStatusChange);

  /** The card shows what follows from the robot's status. */
  function onStatusChange() {
    onNews(true);
  }

  /** No message tells that the symptoms of an alarm have cleared. */
  function renewLater(isNews) {
    if (isNews) renewSettled();
  }

  function onNews(isNews) {
    if (!place.isConnected) unsubscribers.forEach((end) => end());
    else if (isNews) renew();
  }
}
