// How far copying is: nobody tells of bytes that come, so it is asked for every ten seconds while one looks.

import { all, one } from "../dom.js";
import { listen } from "../feed.js";
import { piece, put } from "../pieces.js";

const EVERY_MS = 10_000;
/** Many robots come at once when a server or a network is back. */
const SOON_MS = 500;

/**
 * Keep the states of robots right; `changed(robot, isAll)` hears of those of which something is
 * new: with `isAll` more than how many bytes have come. Returns what asks at once, and what
 * asks soon.
 * @param {() => string[]} shown the robots that one looks at
 * @param {(robot: string, isAll: boolean) => void} changed
 */
export function followStates(shown, changed) {
  let isAsking = false;

  async function look() {
    const robots = shown();
    if (isAsking || !robots.length || document.visibilityState === "hidden") return;
    isAsking = true;
    const query = new URLSearchParams(robots.map((robot) => ["robot", robot]));
    const fresh = await piece(`/pieces/recordings?${query}`).catch(() => null); // the next time it may be there again
    isAsking = false;
    for (const state of fresh ? all("[data-state]", fresh) : []) place(state, changed);
  }

  setInterval(look, EVERY_MS);
  document.addEventListener("visibilitychange", look);
  const feed = listen({ kinds: ["presence"] });
  const soon = once(look, SOON_MS);
  feed.on("presence", (_, robot) => {
    if (shown().includes(robot)) soon();
  });
  feed.on("snapshot", soon);
  return { look, soon };
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
