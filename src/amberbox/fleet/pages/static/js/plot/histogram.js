/** How often a variable had which values in a window. */

import { plain } from "./axes.js";
import { ask } from "../ask.js";
import { el, setText } from "../dom.js";
import { figure } from "./canvas.js";
import { asked } from "./data.js";
import { t } from "../strings.js";

const HEIGHT = 300;
const BARS = 50;

/**
 * Show a histogram inside an element; returns `update(from, to)` and `destroy()`.
 * @param {HTMLElement} element
 * @param {{trace: import("./plot.js").Added, from: number, to: number}} about
 */
export function histogram(element, { trace, from, to }) {
  const state = { bars: null, control: null };
  const title = trace.label ?? trace.variable;
  const name = trace.unit ? `${title} [${trace.unit}]` : title;
  const shown = figure(element, { height: HEIGHT, label: t("plot.histogram", { name }),
    draw: (pen) => draw(pen, state.bars, name, trace.labels ?? {}) });
  const note = el("p", { class: "small muted", role: "status" });
  const list = el("table", {});
  shown.root.append(el("figcaption", {}, note), el("div", { class: "sr-only" }, list));

  /** Show another window. Throws AskError. */
  async function update(begin, end) {
    state.control?.abort();
    state.control = new AbortController();
    const found = await load(trace, begin, end, state.control.signal);
    const sums = found.variables[0];
    state.bars = sums?.histogram ?? null;
    setText(note, t(wordOf(sums, found.exact), { n: (sums?.count ?? 0).toLocaleString("en") }));
    list.replaceChildren(el("caption", {}, t("plot.histogram", { name })), ...rowsOf(state.bars, trace));
    shown.redraw();
  }

  return { update, destroy: shown.destroy, ready: update(from, to) };
}

function load(trace, from, to, signal) {
  const query = new URLSearchParams({ item: trace.item, variables: trace.variable, from: asked(from), to: asked(to), bins: BARS });
  return ask(`/api/v1/robots/${encodeURIComponent(trace.robot)}/statistics?${query}`, { signal });
}

function wordOf(sums, exact) {
  if (!sums?.count) return "plot.none_here";
  return exact ? "plot.histogram_of" : "plot.histogram_steps";
}

function draw(pen, bars, name, labels) {
  if (!bars) return;
  const { edges, counts } = bars;
  const most = counts.reduce((high, count) => Math.max(high, count), 1);
  const [low, high] = [edges[0], edges[edges.length - 1]];
  const named = Object.entries(labels).map(([value, text]) => [Number(value), text]);
  const names = named.length ? named.filter(([value]) => value > low && value < high) : undefined;
  const place = pen.axes({ low, high, label: name, names },
    { low: 0, high: most * 1.05, label: t("plot.count") });
  pen.context.fillStyle = pen.colours.plot[0];
  counts.forEach((count, n) => {
    const left = place.x(edges[n]);
    const top = place.y(count);
    pen.context.fillRect(left, top, Math.max(place.x(edges[n + 1]) - left - 1, 1), place.bottom - top);
  });
}

function rowsOf(bars, { labels = {} }) {
  if (!bars) return [];
  const { edges, counts } = bars;
  return counts.map((count, n) => {
    const middle = (edges[n] + edges[n + 1]) / 2;
    const value = labels[middle] ?? `${plain(edges[n])} – ${plain(edges[n + 1])}`;
    return el("tr", {}, el("th", { scope: "row" }, value), el("td", {}, count.toLocaleString("en")));
  });
}
