// The card of a diagnosis, wherever it stands: explained, answered, and renewed in its place.

import { fail, toast } from "../ask.js";
import { one } from "../dom.js";
import { pieces, replace } from "../pieces.js";
import { t } from "../strings.js";

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

  place.addEventListener("done", async (event) => {
    if (!event.target.closest("[data-answers]")) return;
    await renew();
    toast(t("diagnosis.anew"));
  });
  place.addEventListener("click", (event) => {
    if (event.target.closest("[data-again]")) renew();
  });
  if (feed) follow(feed, place, robot, renew);
  if (one("[data-complete='yes']", place) === null) renew();
  return renew;
}

/** Renew at each diagnosis and after an absence, for as long as the place is on the page. */
function follow(feed, place, robot, renew) {
  let snapshots = 0;
  const ends = [
    feed.on("diagnosis", (_, of) => hear(of === robot)),
    feed.on("snapshot", () => hear((snapshots += 1) > 1)),
  ];

  function hear(isNews) {
    if (!place.isConnected) ends.forEach((end) => end());
    else if (isNews) renew();
  }
}
