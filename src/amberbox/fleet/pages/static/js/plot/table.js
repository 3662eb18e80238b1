/** The table below the panels: values at the cursor, and what the window sums up to. */

import { plain } from "./axes.js";
import { el, setText } from "../dom.js";
import { breakable } from "../names.js";
import { placeAt } from "./data.js";
import { t } from "../strings.js";

const COLUMNS = ["value", "least", "mean", "greatest", "count", "shown"];

/** Make the table. @param {{colours: any}} stack */
export function readout(stack) {
  const time = el("span", { class: "plot-time" });
  const heads = COLUMNS.map((name) => el("th", { scope: "col", class: "num" }, t(`plot.${name}`)));
  const body = el("tbody");
  const table = el("table", { class: "table plot-readout" },
    el("caption", { class: "sr-only" }, t("plot.readout")),
    el("thead", {}, el("tr", {}, el("th", { scope: "col" }, t("plot.variable")), ...heads)), body);
  const scroll = el("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": t("plot.readout") }, table);
  return { stack, root: el("div", { class: "plot-values" }, time, scroll), time, body, rows: new Map() };
}

/** Show the variables that there are, their values at the cursor, and sums of the window. */
export function fill(shown, traces, time) {
  for (const [id, row] of shown.rows) {
    if (traces.some((trace) => trace.id === id)) continue;
    row.root.remove();
    shown.rows.delete(id);
  }
  for (const trace of traces) {
    const row = shown.rows.get(trace.id) ?? addRow(shown, trace);
    row.swatch.style.background = shown.stack.colours.now.plot[trace.colour];
    write(row.cells, trace, time, shown.stack.gapsOf(trace));
  }
}

/** The value of a variable at a time, in words. @returns {{text: string, note: string}} */
export function valueAt(trace, time, gaps) {
  const gap = gaps.find((one) => one.from <= time && time < one.to);
  const series = trace.live && time >= trace.live.x[0] ? trace.live : trace.series;
  const place = series ? placeAt(series, time) : -1;
  if (gap && gap.kind !== "filtered" && !(place >= 0 && series.x[place] >= gap.from)) {
    return { text: "–", note: gap.kind === "refused" ? t("plot.hole.refused") : gap.reason };
  }
  if (place < 0) return { text: "–", note: "" };
  return valueOf(trace, series, place, time);
}

function valueOf(trace, series, place, time) {
  const isHeld = time - series.x[place] > series.silence;
  if (series.envelope) {
    if (isHeld || Number.isNaN(series.low[place])) return { text: "–", note: "" };
    const [low, high] = [series.low[place], series.high[place]].map((v) => named(trace, v, v));
    return { text: low === high ? low : `${low} … ${high}`, note: "" };
  }
  const isLast = place === series.x.length - 1;
  if (isHeld && isLast) return { text: "–", note: t("plot.nothing_since") };
  return { text: named(trace, series.low[place], series.raw[place]), note: isHeld ? t("plot.held") : "" };
}

/** A value by its name, where values have names. */
function named(trace, place, raw) {
  if (Number.isNaN(place)) return "–";
  return trace.names[place] === "" ? t("plot.empty_text") : trace.names[place] ?? plain(raw);
}

function addRow(shown, trace) {
  const swatch = el("span", { class: "plot-swatch", "aria-hidden": "true" });
  const cells = Object.fromEntries(COLUMNS.map((name) => [name, el("td", { class: "num nowrap" })]));
  const unit = trace.unit ? el("span", { class: "muted" }, ` ${trace.unit}`) : null;
  const head = el("th", { scope: "row" }, swatch, el("span", {}, ...breakable(trace.label)), unit);
  const root = el("tr", {}, head, ...Object.values(cells));
  shown.body.append(root);
  const row = { root, swatch, cells };
  shown.rows.set(trace.id, row);
  return row;
}

function write(cells, trace, time, gaps) {
  const { text, note } = time === null ? { text: "", note: "" } : valueAt(trace, time, gaps);
  setText(cells.value, note ? `${text} (${note})` : text);
  const sums = trace.sums;
  for (const [name, key] of [["least", "min"], ["mean", "mean"], ["greatest", "max"]]) {
    setText(cells[name], sums ? sumText(trace, key, sums[key]) : "");
  }
  setText(cells.count, sums ? (sums.exact ? "" : "≈ ") + sums.count.toLocaleString("en") : "");
  setText(cells.shown, shownText(trace));
}

function sumText(trace, key, value) {
  if (value === null || (key === "mean" && trace.names.length)) return "–";
  return trace.names[trace.codes.indexOf(value)] ?? plain(value);
}

/** How many rows one point of the plot stands for, in words; empty while nothing is there. */
export function shownText(trace) {
  if (!trace.series) return "";
  const ratio = ratioOf(trace);
  return ratio > 1 ? t("plot.aggregated", { n: ratio.toLocaleString("en") }) : t("plot.every");
}

/** How many rows one point of the plot stands for. */
export function ratioOf({ series }) {
  if (!series || !series.x.length) return 1;
  return Math.max(1, Math.round(series.of / series.x.length));
}
