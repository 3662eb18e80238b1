// How far copying is: nobody tells of it, so it is asked for every ten seconds while one looks.

import { all, one } from "./dom.js";
import { listen } from "./feed.js";
import { piece, put } from "./pieces.js";

const EVERY_MS = 10_000;

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
  feed.on("presence", look);
  feed.on("snapshot", look);
  return look;
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
