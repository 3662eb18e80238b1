// Whether a robot is there, and since when nothing counts that the page shows of it.

import { one, setText } from "../dom.js";
import { t } from "../strings.js";
import { local, nowMs } from "../time.js";

const SILENT_S = 10;

/**
 * Say on the page when nothing counts. Returns `set(presence)`, what is known of its link, and
 * `say()`, to be called now and then.
 * @param {HTMLElement} page
 * @param {() => number | null} newest how old the newest of all that it says is, in s
 */
export function silence(page, newest) {
  const presence = {
    online: page.dataset.online === "yes", silent: page.dataset.silent === "yes", seenMs: Date.parse(page.dataset.seen),
  };
  /** Since when the watcher has said nothing. @type {number | null} */
  let quietMs = null;

  /** Say why nothing counts, if so: since when, not for how long, as it is read aloud at each change. */
  function say() {
    const text = why();
    page.classList.toggle("is-silent", text !== "");
    one("#summary").hidden = text !== "";
    one("#silence").hidden = text === "";
    setText(one("#silence span"), text);
  }

  function why() {
    if (!presence.online) return presence.seenMs ? t("robot.offline", { text: local(presence.seenMs) }) : "";
    if (presence.silent) return t("robot.silent_link", { text: local(presence.seenMs, "time") });
    const age = newest();
    quietMs = age !== null && age > SILENT_S ? (quietMs ?? nowMs() - age * 1000) : null;
    return quietMs === null ? "" : t("robot.silent_watcher", { text: local(quietMs, "time") });
  }

  function set({ online, silent = false, seen = null }) {
    if (!online && presence.online && !presence.silent) presence.seenMs = nowMs();
    if (seen) presence.seenMs = Date.parse(seen);
    Object.assign(presence, { online, silent });
    say();
  }

  return { set, say };
}
