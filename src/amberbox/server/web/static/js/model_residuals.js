// Residuals of a model: their sizes over the robot's record, with their thresholds.

import { requestJson, robotApi } from "./api.js";
import { loadItems } from "./data_variables.js";
import { find, pageData } from "./dom.js";
import { plots } from "./plot/plot.js";
import { t } from "./strings.js";
import { secondsParam, stampToSeconds } from "./time.js";

const SHOWN_S = 600;
const [SIZE, THRESHOLD] = [0, 1]; // colours, the same in each plot

const { robot, model, residuals } = pageData("residuals-about");
loadItems(robot).then(draw).catch(() => draw([]));

/** Draw the last minutes of what the residuals read. */
function draw(items) {
  const read = items.filter((item) => residuals.some((one) => one.item === item.name) && item.last);
  find("#residual-nothing").hidden = read.length > 0;
  if (!read.length) return;
  const to = Math.max(...read.map((item) => item.last));
  const first = Math.min(...read.map((item) => item.first));
  const window = { from: Math.max(to - SHOWN_S, Math.min(first, to - 1)), to };
  const stack = plots(find("#residual-plots"), { ...window, whole: window, fixed: true });
  for (const one of residuals) {
    stack.add(curve(one, one.name, SIZE, (...args) => sizes(one, ...args)));
    for (const sign of one.threshold === null ? [] : [1, -1]) {
      const label = t(sign > 0 ? "models.above" : "models.below");
      stack.add(curve(one, label, THRESHOLD, (from, to) => constant(from, to, sign * one.threshold)));
    }
  }
}

function curve(one, label, colour, request) {
  return { colour, id: `${one.name} ${label}`, robot, item: one.item, variable: one.name, label, panel: one.name, request };
}

/** Load the size of a residual. @returns {Promise<import("./plot/series.js").Series>} */
async function sizes(one, from, to, points, signal) {
  const query = new URLSearchParams({ model, residual: one.name, from: secondsParam(Math.max(from, 0)), to: secondsParam(to), points });
  const found = await requestJson(`${robotApi(robot)}/residual?${query}`, { signal });
  const x = Float64Array.from(found.times, stampToSeconds);
  return seriesFrom(x, Float64Array.from(found.sizes, (size) => size ?? NaN), found.of, 2 * found.step_s);
}

const constant = (from, to, value) => Promise.resolve(seriesFrom(Float64Array.of(from, to), Float64Array.of(value, value), 2, Infinity));

function seriesFrom(x, values, of, silence) {
  return { x, low: values, high: values, mean: values, raw: values, envelope: false, step: 0, of, silence, completeTo: null };
}
