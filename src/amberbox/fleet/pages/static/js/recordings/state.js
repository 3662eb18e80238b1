// How far copying is: nobody tells of it, so it is asked for every ten seconds while one looks.

import { all, one } from "../dom.js";
import { listen } from "../feed.js";
import { piece, put } from "../pieces.js";

const EVERY_MS = 10_000;
/** Many robots come at once when a server or a network is back. */
const SOON_MS = 500;

/**
 * Keep the states of robots right; `changed(robot, isAll)` hears of those of which something is
 * new: with `isAll` more than how many bytes have come. Returns what asks at once.
 * @param {string} path
 * @param {(robot: string, isAll: boolean) => void} changed
 */
export function followStates(path, changed) {
  let isAsking = false;

  async function look() {
    if (isAsking || document.visibilityState === "hidden") return;
    isAsking = true;
    const fresh = await piece(path).catch(() => null); // the next time it may be there again
    isAsking = false;
    for (const state of fresh ? all("[data-state]", fresh) : []) place(state, changed);
  }

  setInterval(look, EVERY_MS);
  document.addEventListener("visibilitychange", look);
  const feed = listen({ kinds: ["presence"] });
  const soon = once(look, SOON_MS);
  feed.on("presence", (_, robot) => {
    if (one(`[data-state="${CSS.escape(robot)}"]`)) soon();
  });
  feed.on("snapshot", soon);
  return look;
}

/** Return what calls something after a while, once for all that asked for it meanwhile. */
function once(fn, afterMs) {
  let timer = null;
  return () => {
    timer ??= setTimeout(() => {
      timer = null;
      fn();
    }, afterMs);
  };
}

function place(fresh, changed) {
  const { state, stamp, coming } = fresh.dataset;
  const old = one(`[data-state="${CSS.escape(state)}"]`);
  if (!old) return;
  const isAll = old.dataset.stamp !== stamp;
  const isMore = isAll || old.dataset.coming !== coming;
  put(old, fresh);
  if (isMore) changed(state, isAll);
}
