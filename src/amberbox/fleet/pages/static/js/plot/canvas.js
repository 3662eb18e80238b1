/** A canvas with axes for figures that are not over time: XY views and histograms. */

import { plain } from "./axes.js";
import { el, setWords, visible } from "../dom.js";
import { colours, onTheme } from "./look.js";

const LEFT = 64;
const RIGHT = 16;
const TOP = 12;
const BOTTOM = 44;
const FONT = "12px system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif";
const STEPS = [1, 2, 2.5, 5, 10];
const MARGIN = 0.05;

/**
 * Make a figure that fills its element's width.
 * @param {HTMLElement} element
 * @param {{height: number, label: string, draw: function(any): void}} about `draw` gets a pen with
 *   `context`, `colours`, `width`, `height`, and `axes(...)`, which returns where values lie
 */
export function figure(element, { height, label, draw }) {
  const end = new AbortController();
  const canvas = el("canvas", { role: "img", "aria-label": label });
  const root = el("figure", { class: "plot-figure" }, canvas);
  element.append(root);
  const redraw = () => {
    const width = root.clientWidth;
    if (width) draw(penOf(canvas, width, height, colours(root)));
  };
  const watcher = new ResizeObserver(redraw);
  watcher.observe(root);
  onTheme(redraw, end.signal);
  const describe = (text) => setWords(canvas, "aria-label", text);
  function destroy() {
    end.abort();
    watcher.disconnect();
    root.remove();
  }
  return { root, canvas, redraw, describe, destroy };
}

function penOf(canvas, width, height, shades) {
  const dpr = window.devicePixelRatio;
  canvas.width = Math.round(width * dpr);
  canvas.height = Math.round(height * dpr);
  canvas.style.height = `${height}px`;
  const context = canvas.getContext("2d");
  context.setTransform(dpr, 0, 0, dpr, 0, 0);
  context.font = FONT;
  return { context, colours: shades, width, height, axes: (x, y) => axes(context, shades, width, height, x, y) };
}

/**
 * Draw axes. @param {{low: number, high: number, label: string,
 *   names?: [number, string][]}} x `names` of values stand where numbers would @param {typeof x} y
 * @returns {{x: function(number): number, y: function(number): number, bottom: number}}
 */
function axes(context, shades, width, height, x, y) {
  const right = width - RIGHT;
  const bottom = height - BOTTOM;
  const place = {
    x: (value) => LEFT + ((value - x.low) / (x.high - x.low)) * (right - LEFT),
    y: (value) => bottom - ((value - y.low) / (y.high - y.low)) * (bottom - TOP),
    bottom,
  };
  context.strokeStyle = shades.line;
  context.fillStyle = shades.ink;
  context.lineWidth = 1;
  const names = x.names && new Map(x.names);
  for (const value of names?.keys() ?? ticks(x.low, x.high, (right - LEFT) / 80)) {
    const at = Math.round(place.x(value)) + 0.5;
    rule(context, at, TOP, at, bottom);
    write(context, names?.get(value) ?? plain(value), at, bottom + 16, "center");
  }
  for (const value of ticks(y.low, y.high, (bottom - TOP) / 34)) {
    const at = Math.round(place.y(value)) + 0.5;
    rule(context, LEFT, at, right, at);
    write(context, plain(value), LEFT - 6, at + 4, "right");
  }
  write(context, x.label, (LEFT + right) / 2, height - 8, "center");
  context.save();
  context.translate(12, (TOP + bottom) / 2);
  context.rotate(-Math.PI / 2);
  write(context, y.label, 0, 0, "center");
  context.restore();
  return place;
}

/** A range with some room around it. */
export function roomy(low, high) {
  const more = (high - low) * MARGIN || Math.abs(high) * MARGIN || 1;
  return { low: low - more, high: high + more };
}

function ticks(low, high, most) {
  const rough = (high - low) / Math.max(most, 1);
  const size = 10 ** Math.floor(Math.log10(rough));
  const step = size * STEPS.find((one) => one * size >= rough);
  const first = Math.ceil(low / step);
  const last = Math.floor(high / step);
  return Array.from({ length: Math.max(last - first + 1, 0) }, (_, n) => Number(((first + n) * step).toPrecision(12)));
}

function rule(context, x1, y1, x2, y2) {
  context.beginPath();
  context.moveTo(x1, y1);
  context.lineTo(x2, y2);
  context.stroke();
}

function write(context, text, x, y, align) {
  context.textAlign = align;
  context.fillText(visible(String(text)), x, y);
}
