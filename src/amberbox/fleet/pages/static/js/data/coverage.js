/**
 * What there is of a robot over all time: where it is recorded, and what is missing.
 *
 * @typedef {{start: ?number, end: ?number, recorded: {start: number, end: number}[],
 *   missing: {start: number, end: number, kind: string, reason: string}[]}} Coverage seconds;
 *   null of nothing
 */

import { ask } from "../ask.js";

/** So much of a window may be without data at its end before one is told. */
const EDGE = 0.05;
const NOTHING = { start: null, end: null, recorded: [], missing: [] };

/** Ask for it; null when it cannot be had now. @returns {Promise<?Coverage>} */
export async function askCoverage(robot) {
  const found = await ask(`/robots/${encodeURIComponent(robot)}/data/coverage`).catch(() => null);
  return found && found.start === null ? NOTHING : found;
}

/**
 * Tell whether the robot may have something of a window that is not here.
 * @param {Coverage} cover @param {{from: number, to: number}} window @param {number} now
 */
export function lacks(cover, { from, to }, now) {
  const behind = cover.end === null || to - cover.end > EDGE * (to - from);
  const within = cover.missing.some((one) => one.kind === "to_come" && one.start < to && one.end > from);
  return (behind && from < now) || within;
}
