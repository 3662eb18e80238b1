/** The legend of a panel: which line is what, its value at the cursor, how much was summed up. */

import { el, icon, setText } from "../dom.js";
import { breakable } from "../names.js";
import { kindOver } from "./gaps.js";
import { ratioOf, shownText, valueAt } from "./table.js";
import { partOf } from "./trace.js";
import { t } from "../strings.js";

/** Make the key of a variable. @param {any} shown its panel @param {any} trace */
export function makeKey(shown, trace) {
  const { stack } = shown;
  const swatch = el("span", { class: "plot-swatch", "aria-hidden": "true" });
  const value = el("span", { class: "plot-value num" });
  const badge = el("span", { class: "badge plot-badge" });
  const problem = el("span", { class: "plot-problem", role: "alert" });
  const remove = el("button", {
    type: "button", class: "button quiet small icon-only no-print",
    "aria-label": t("plot.remove", { name: trace.label }), title: t("plot.remove", { name: trace.label }),
    onclick: () => stack.drop(trace.id),
  }, icon("close"));
  const name = trace.unit ? `${trace.label} [${trace.unit}]` : trace.label;
  const root = el("li", { class: "plot-key" }, swatch, el("span", { class: "plot-name" }, ...breakable(name)), value, badge,
    problem, stack.options.fixed ? null : remove);
  for (const [event, id] of [["pointerenter", trace.id], ["pointerleave", ""]]) {
    root.addEventListener(event, () => stack.strengthen(shown, id));
  }
  return { root, swatch, value, badge, problem };
}

/** Bring a key up to date. */
export function writeKey(key, trace, stack) {
  key.swatch.style.background = stack.colours.now.plot[trace.colour];
  const time = stack.cursor;
  const { text, note } = time === null ? { text: "", note: "" } : valueAt(trace, time, stack.gapsOf(trace));
  setText(key.value, note ? `${text} (${note})` : text);
  key.badge.hidden = ratioOf(trace) === 1;
  setText(key.badge, shownText(trace));
  setText(key.problem, problemOf(trace, stack));
  key.problem.hidden = !key.problem.textContent;
  key.root.classList.toggle("plot-waiting", !trace.series && !trace.problem);
}

function problemOf(trace, stack) {
  const { problem, series, live } = trace;
  if (problem) return problem.hint ? `${problem.message}. ${problem.hint}` : problem.message;
  if (!series || series.x.length || live) return "";
  const kind = kindOver(stack.gapsOf(trace), partOf(trace, stack.view));
  return kind ? t("plot.none_because", { why: t(`plot.hole.${kind}`) }) : t("plot.none_here");
}
