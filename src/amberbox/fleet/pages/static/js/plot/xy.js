/** One variable against another, coloured by time: early dots in one colour, late in another. */

import { askPlot } from "../ask.js";
import { el, setText } from "../dom.js";
import { figure, roomy } from "./canvas.js";
import { asked, firstFrom, placeAt, seriesOf } from "./data.js";
import { moment } from "./time.js";
import { t } from "../strings.js";

const POINTS = 4000;
const HEIGHT = 420;
const SHADES = 24;
const DOT = 2.2;

/**
 * Show an XY view inside an element; returns `update(from, to)` and `destroy()`.
 * @param {HTMLElement} element
 * @param {{x: import("./plot.js").Added, y: import("./plot.js").Added, from: number, to: number}} about
 */
export function xyView(element, { x, y, from, to }) {
  const state = { from, to, points: null, control: null };
  const shown = figure(element, { height: HEIGHT, label: t("plot.xy", { x: nameOf(x), y: nameOf(y) }),
    draw: (pen) => draw(pen, state, x, y) });
  const legend = el("p", { class: "row small muted" });
  const note = el("p", { class: "small muted", role: "status" });
  shown.root.append(el("figcaption", {}, legend, note));

  /** Show another window. Throws AskError. */
  async function update(begin, end) {
    state.control?.abort();
    state.control = new AbortController();
    const { signal } = state.control;
    const [first, second] = await Promise.all([x, y].map((one) => load(one, begin, end, signal)));
    Object.assign(state, { from: begin, to: end, points: paired(first, second) });
    legend.replaceChildren(moment(begin, 1), " ", el("span", { class: "plot-ramp", "aria-hidden": "true" }), " ", moment(end, 1));
    setText(note, noteOf(state.points, first, second));
    shown.redraw();
  }

  return { update, destroy: shown.destroy, ready: update(from, to) };
}

async function load(one, from, to, signal) {
  const query = new URLSearchParams({ item: one.item, variables: one.variable, from: asked(from), to: asked(to),
    points: POINTS, format: "plot" });
  return seriesOf(await askPlot(`/api/v1/robots/${encodeURIComponent(one.robot)}/query?${query}`, { signal }));
}

/** Give each value of the one that has fewer rows the value that the other has then. */
function paired(first, second) {
  const isFirst = first.x.length <= second.x.length;
  const [few, many] = isFirst ? [first, second] : [second, first];
  const found = [];
  few.x.forEach((time, n) => {
    const value = valueAt(many, time);
    const own = few.mean[n];
    if (!Number.isNaN(value) && !Number.isNaN(own)) found.push(isFirst ? [own, value, time] : [value, own, time]);
  });
  return found;
}

/** The value at a time: between two neighbouring rows, NaN where there is none nearby. */
function valueAt(series, time) {
  const before = placeAt(series, time);
  const behind = firstFrom(series.x, time);
  if (before < 0 || time - series.x[before] > series.silence) return NaN;
  if (behind >= series.x.length || behind === before || series.x[behind] - series.x[before] > series.silence) return series.mean[before];
  const part = (time - series.x[before]) / (series.x[behind] - series.x[before]);
  return series.mean[before] + part * (series.mean[behind] - series.mean[before]);
}

function noteOf(points, first, second) {
  if (!points.length) return t("plot.xy_none");
  const of = Math.max(first.of, second.of);
  return of > 1.5 * points.length ? t("plot.xy_thinned", { n: points.length.toLocaleString("en"), of: of.toLocaleString("en") })
    : t("plot.xy_points", { n: points.length.toLocaleString("en") });
}

function draw(pen, { points, from, to }, x, y) {
  if (!points?.length) return;
  const range = (k) => {
    const values = points.map((point) => point[k]);
    return roomy(values.reduce((a, b) => Math.min(a, b)), values.reduce((a, b) => Math.max(a, b)));
  };
  const place = pen.axes({ ...range(0), label: nameOf(x) }, { ...range(1), label: nameOf(y) });
  const shades = ramp(pen.colours);
  const { context } = pen;
  for (const [across, up, time] of points) {
    const shade = Math.min(SHADES - 1, Math.max(0, Math.floor(((time - from) / (to - from)) * SHADES)));
    context.fillStyle = shades[shade];
    context.beginPath();
    context.arc(place.x(across), place.y(up), DOT, 0, 2 * Math.PI);
    context.fill();
  }
}

/** Colours from early to late, through three of the style: the same as `.plot-ramp`. */
function ramp({ plot }) {
  const ends = [plot[5], plot[3], plot[1]];
  return Array.from({ length: SHADES }, (_, n) => {
    const part = (n / (SHADES - 1)) * 2;
    const first = Math.min(Math.floor(part), 1);
    return `color-mix(in srgb, ${ends[first + 1]} ${Math.round((part - first) * 100)}%, ${ends[first]})`;
  });
}

const nameOf = (one) => (one.unit ? `${one.label ?? one.variable} [${one.unit}]` : one.label ?? one.variable);
