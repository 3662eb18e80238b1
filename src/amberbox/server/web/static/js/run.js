// A run: its parts, and plots of the variables that matter, live while it goes on.

import { findVariable, loadItems } from "./data_variables.js";
import { el, find, pageData } from "./dom.js";
import { plots } from "./plot/plot.js";
import { keepRunCurrent } from "./run_parts.js";
import { t } from "./strings.js";
import { nowMs, stampToSeconds } from "./time.js";

const LEAST_S = 30;

const page = find("#run");
const { run, robot, role, address } = page.dataset;
const isOn = () => find("#run-parts").dataset.over === "no";
const { feed } = keepRunCurrent("run-parts", {
  address: () => address, robots: [robot], run: () => (isOn() ? run : ""), robot: () => robot, role: () => role, placed: follow,
});

const about = pageData("plots-about");
const drawn = about ? drawPlots(find("#run-plots"), about).catch(() => null) : null; // the page says what it lacks
if (about && !about.to) drawn.then((plot) => plot?.stack.live(feed));

/** Load the page again when a planned run has begun: there is more on it then. */
function follow() {
  if (find("#run-parts").dataset.begun && !page.dataset.begun) location.reload();
  endPlots();
}

/** Stop following live values when the run is over, and show the time that it took. */
function endPlots() {
  const { ended } = find("#run-parts").dataset;
  if (!about || about.to || !ended) return;
  about.to = ended;
  drawn.then((plot) => {
    plot?.stack.live(null);
    plot?.stack.window(plot.begin, stampToSeconds(ended), { silent: true });
  });
}

/**
 * Draw the variables of a run. While it goes on, those that are not in the archive yet are drawn
 * from their live values alone; afterwards they are named.
 */
async function drawPlots(place, { robot, plots: names, from, to }) {
  const items = await loadItems(robot);
  const traces = names.map((name) => traceOptions(robot, name, findVariable(items, name), !to));
  for (const [n, trace] of traces.entries()) if (!trace) place.append(el("p", { class: "muted small" }, t("runs.no_variable", { name: names[n] })));
  if (!traces.some(Boolean)) return null;
  const begin = stampToSeconds(from);
  const end = stampToSeconds(to) ?? Math.max(nowMs() / 1000, begin + LEAST_S);
  const stack = plots(place, { from: begin, to: end, whole: { from: begin, to: end }, fixed: true });
  for (const trace of traces) if (trace) stack.add(trace);
  return { stack, begin };
}

/** Return the options of a variable for `plots`; null for one that cannot be drawn. */
function traceOptions(robot, name, variable, isLive) {
  const about = { id: name, robot, label: name };
  if (variable) return { ...about, item: variable.item, variable: variable.name, unit: variable.unit, labels: variable.labels, kind: variable.kind };
  const dot = name.indexOf(".");
  return isLive && dot > 0 ? { ...about, item: name.slice(0, dot), variable: name.slice(dot + 1), kind: "number", isArchived: false } : null;
}
