/** Which window of time an address means, and where the newest data are. */

import { ask } from "../ask.js";
import { around, spanOf } from "./goto.js";
import { sane } from "../plot/view.js";
import { timeOf } from "../timewords.js";

const HOUR_S = 3600;
const RECENT = 0.25;

/**
 * What an address means: its window and the missions it compares. Of a mission that cannot be had
 * `refused` is told, and the newest hour takes its place.
 * @param {import("./view.js").Look} look @param {string} path of the robot in the API
 * @param {{now: number, last: ?number}} marks @param {function(Error): void} refused
 */
export async function meaning(look, path, marks, refused) {
  try {
    const missions = await Promise.all(look.compare.map((id) => ask(missionPath(path, id))));
    return { look, missions, window: await windowOf(look, path, marks) };
  } catch (error) {
    refused(error);
    const rest = { ...look, mission: "", compare: [] };
    return { look: rest, missions: [], window: await windowOf(rest, path, marks) };
  }
}

const missionPath = (path, id) => `${path}/missions/${encodeURIComponent(id)}`;

/**
 * The window that an address means: a mission, two times, or the newest hour; as plots can show it.
 * @param {import("./view.js").Look} look @param {string} path of the robot in the API
 * @param {{now: number, last: ?number}} marks
 */
async function windowOf({ from, to, mission, live }, path, marks) {
  if (mission && !from && !to) {
    const [begin, end] = around(spanOf(await ask(missionPath(path, mission))));
    return { from: begin, to: end };
  }
  const newest = live || from.startsWith("now") ? marks.now : newestEnd(HOUR_S, marks);
  const end = timeOf(to, marks) ?? newest;
  const begin = timeOf(from, marks) ?? end - HOUR_S;
  return sane(begin < end ? { from: begin, to: end } : { from: end - HOUR_S, to: end });
}

/** Where a window ends that is to hold the newest data: now, unless they are older than that. */
export function newestEnd(width, { now, last }) {
  return last === null || now - last < width * RECENT ? now : last;
}

/**
 * All time of which something is known; a window where nothing is.
 * @param {?import("./coverage.js").Coverage} cover @param {{first: ?number, last: ?number}} reach
 * @param {import("../plot/view.js").Span} window
 */
export function whole(cover, { first, last }, window) {
  const known = [cover?.start, cover?.end, first, last].filter((time) => time !== null && time !== undefined);
  return known.length ? sane({ from: Math.min(...known), to: Math.max(...known) }) : window;
}
