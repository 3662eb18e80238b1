// Progress of copying recordings from robots: polled every ten seconds while the page is visible.

import { find, findAll } from "./dom.js";
import { subscribe } from "./feed.js";
import { fetchFragment, replaceElement } from "./fragments.js";

const INTERVAL_MS = 10_000;
// many robots connect at once when a server or a network is back
const GROUP_MS = 500;

/**
 * Keep the states of robots current. `changed(robot, isAll)` is called for those that changed; without
 * `isAll` only the number of copied bytes did. Returns `update()` and `updateSoon()`.
 * @param {() => string[]} visibleRobots
 * @param {(robot: string, isAll: boolean) => void} changed
 */
export function followStates(visibleRobots, changed) {
  let isRunning = false;

  async function update() {
    const robots = visibleRobots();
    if (isRunning || !robots.length || document.visibilityState === "hidden") return;
    isRunning = true;
    const query = new URLSearchParams(robots.map((robot) => ["robot", robot]));
    const fresh = await fetchFragment(`/pieces/recordings?${query}`).catch(() => null); // tried again the next time
    isRunning = false;
    for (const state of fresh ? findAll("[data-state]", fresh) : []) placeState(state, changed);
  }

  setInterval(update, INTERVAL_MS);
  document.addEventListener("visibilitychange", update);
  const feed = subscribe({ kinds: ["presence"] });
  const updateSoon = grouped(update, GROUP_MS);
  feed.on("presence", (_, robot) => {
    if (visibleRobots().includes(robot)) updateSoon();
  });
  feed.on("snapshot", updateSoon);
  return { update, updateSoon };
}

/** Return a function that calls `fn` after a while, once for all calls until then. */
function grouped(fn, afterMs) {
  let timer = null;
  return () => {
    timer ??= setTimeout(() => {
      timer = null;
      fn();
    }, afterMs);
  };
}

function placeState(fresh, changed) {
  const { state, stamp, coming } = fresh.dataset;
  const old = find(`[data-state="${CSS.escape(state)}"]`);
  if (!old) return;
  const isAll = old.dataset.stamp !== stamp;
  const hasChanged = isAll || old.dataset.coming !== coming;
  replaceElement(old, fresh);
  if (hasChanged) changed(state, isAll);
}
