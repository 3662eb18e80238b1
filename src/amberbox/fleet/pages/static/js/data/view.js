/**
 * What the data page shows, as its address holds it. Times stay as they were written until
 * somebody moves the window: `now-1h` stays right for whom it is sent to.
 *
 * @typedef {{plot: number, name: string}} Named a variable by its name, and in which plot it is
 * @typedef {object} Look
 * @property {Named[]} named @property {string} from @property {string} to @property {boolean} live
 * @property {"time"|"xy"|"hist"} mode @property {string[]} compare ids of two missions, or none
 * @property {string} mission id of the mission that gives the window, or empty
 * @property {string} x @property {string} y variables of the XY view, empty for the first two
 */

import * as view from "../view.js";

const MODES = ["time", "xy", "hist"];
const MOST = 32;

/** Read the address. @returns {Look} */
export function read() {
  const mode = view.get("mode", "time");
  const compare = view.get("compare").split(",").filter(Boolean);
  return {
    named: numbered(view.list("v").slice(0, MOST)), from: view.get("from"), to: view.get("to"),
    live: view.get("live") === "1", mode: MODES.includes(mode) ? mode : "time",
    compare: compare.length === 2 ? compare : [], mission: view.get("mission"),
    x: view.get("x"), y: view.get("y"),
  };
}

/** Write the address. @param {Look} look */
export function write(look, { push = false } = {}) {
  view.set({
    v: listed(look.named), from: look.from, to: look.to, live: look.live ? "1" : null,
    mode: look.mode === "time" ? null : look.mode, compare: look.compare.join(","), mission: look.mission,
    x: look.mode === "xy" ? look.x : null, y: look.mode === "xy" ? look.y : null,
  }, { push });
}

/** Give each variable its plot: the number before it, else one of its own. @param {string[]} texts */
export function numbered(texts) {
  const found = texts.map((text) => {
    const parts = /^(\d{1,2}):(.+)$/.exec(text);
    return parts ? { plot: Number(parts[1]), name: parts[2] } : { plot: 0, name: text };
  });
  let last = Math.max(0, ...found.map((one) => one.plot));
  return found.map((one) => (one.plot ? one : { ...one, plot: (last += 1) }));
}

/** Write variables as `numbered` reads them: without numbers where each has its own plot. */
export function listed(named) {
  const isPlain = named.every((one, n) => one.plot === n + 1);
  return named.map(({ plot, name }) => (isPlain ? name : `${plot}:${name}`));
}

/** Number plots from 1 without holes, in their order. @param {Named[]} named @returns {Named[]} */
export function tidy(named) {
  const plots = [...new Set(named.map((one) => one.plot))].sort((one, other) => one - other);
  return named.map((one) => ({ ...one, plot: plots.indexOf(one.plot) + 1 }))
    .sort((one, other) => one.plot - other.plot);
}
