// Runs over each other: the curves of each variable, counted from the beginning of its run.

import { findVariable, loadItems } from "./data_variables.js";
import { find, pageData } from "./dom.js";
import { dateTime } from "./plot/axes.js";
import { plots } from "./plot/plot.js";
import { t } from "./strings.js";
import { nowMs, stampToSeconds } from "./time.js";

const { robot, plots: names, runs } = pageData("plots-about");
const begins = runs.map((run) => stampToSeconds(run.from));
const lengths = runs.map((run, n) => (stampToSeconds(run.to) ?? nowMs() / 1000) - begins[n]);
const whole = { from: 0, to: Math.max(...lengths, 1) };
const stack = plots(find("#comparison-plots"), { ...whole, whole, relative: true, fixed: true });
const items = loadItems(robot);
for (const name of names) items.then((known) => addCurves(name, findVariable(known, name))).catch(() => null); // the plot stays empty

/** Add a variable of all runs. */
function addCurves(name, variable) {
  if (!variable) return;
  const { item, unit, labels, kind } = variable;
  runs.forEach((run, n) => stack.add({
    id: `${name} ${run.id}`, robot, item, variable: variable.name, unit, labels, kind, panel: name,
    label: t("runs.of_run", { name, at: dateTime(begins[n], 60) }), origin: begins[n], length: lengths[n],
  }));
}
