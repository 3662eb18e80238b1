/** Tiny lines beside variables: how they went, over all time of their item. Loaded when seen. */

import { askPlot } from "../ask.js";
import { one, svg } from "../dom.js";

const POINTS = 60;
const AT_ONCE = 40;
const PAUSE_MS = 150;
const WIDTH = 60;
const HEIGHT = 16;
const ROOM = 1.5;

/** Make the place of a line. @param {import("./variablelist.js").Variable} variable */
export function spark(variable) {
  return svg("svg", { class: "spark", viewBox: `0 0 ${WIDTH} ${HEIGHT}`, preserveAspectRatio: "none",
    "aria-hidden": "true", "data-spark": variable.address }, svg("path"));
}

/**
 * Draw the lines of what comes into sight: for all variables of an item that are seen together one
 * question. Returns `watch(element)` of an element that holds a place, and `stop()`.
 * @param {string} robot @param {function(string): ?import("./variablelist.js").Variable} of
 */
export function sparklines(robot, of) {
  const known = new Map();
  const waiting = new Map();
  let timer = 0;
  const watcher = new IntersectionObserver((seen) => {
    for (const { isIntersecting, target } of seen) if (isIntersecting) come(target);
  });

  function come(element) {
    watcher.unobserve(element);
    const place = one("[data-spark]", element);
    const variable = of(place.dataset.spark);
    if (!variable || variable.kind === "text" || !variable.kind) return;
    if (known.has(variable.address)) {
      draw(place, known.get(variable.address));
      return;
    }
    waiting.set(place, variable);
    timer ||= setTimeout(load, PAUSE_MS);
  }

  async function load() {
    timer = 0;
    const groups = Map.groupBy([...waiting], ([, variable]) => variable.item);
    waiting.clear();
    for (const [item, group] of groups) {
      for (let n = 0; n < group.length; n += AT_ONCE) await loadSome(item, group.slice(n, n + AT_ONCE));
    }
  }

  async function loadSome(item, group) {
    const query = new URLSearchParams({ item, points: POINTS, format: "plot" });
    for (const [, variable] of group) query.append("variables", variable.name);
    const answer = await askPlot(`/api/v1/robots/${encodeURIComponent(robot)}/query?${query}`).catch(() => null);
    if (!answer) return; // a line beside a name is worth no message
    for (const [place, variable] of group) {
      const line = lineOf(answer, variable.name);
      known.set(variable.address, line);
      draw(place, line);
    }
  }

  return { watch: (element) => watcher.observe(element), stop: () => watcher.disconnect() };
}

/** Write a path of one column. */
function lineOf({ header, columns }, name) {
  const at = header.columns.findIndex((column) => column.name === name || column.name === `${name}:mean`);
  const [times, values] = [columns[0], columns[at + 1]];
  if (at < 0 || !times.length) return "";
  const real = values.filter((value) => Number.isFinite(value));
  const [low, high] = [real.reduce((a, b) => Math.min(a, b), Infinity), real.reduce((a, b) => Math.max(a, b), -Infinity)];
  const [begin, length] = [times[0], times[times.length - 1] - times[0] || 1];
  const y = (value) => (high > low ? HEIGHT - ROOM - ((value - low) / (high - low)) * (HEIGHT - 2 * ROOM) : HEIGHT / 2);
  let pen = "M";
  let path = "";
  for (let n = 0; n < times.length; n++) {
    if (Number.isFinite(values[n])) path += `${pen}${(((times[n] - begin) / length) * WIDTH).toFixed(1)} ${y(values[n]).toFixed(1)}`;
    pen = Number.isFinite(values[n]) ? "L" : "M";
  }
  return path;
}

function draw(place, line) {
  if (line) place.firstChild.setAttribute("d", line);
}
