/**
 * Stretches in which something is missing: a tinted ground, hatched by kind, with a line at both
 * ends and a cap at the top, so that a short one is not taken for a line of the grid.
 */

import { xOf } from "./draw.js";

const TILE_PX = 8;
const CAP_PX = 4;
const LEAST_PX = 3;
const LEAST_CAP_PX = 7;

/**
 * How kinds are hatched, as `.plot-hatch-…` of the style: lines as x1, y1, x2, y2 of a tile, or dots
 * as x, y; ink and ground are colours of the page. One without a ground is nothing to look for.
 */
const HATCHES = {
  filtered: { lines: [[0, 4, 8, 4]], ink: "ink2" },
  lost: { lines: [[0, 8, 8, 0]], ink: "ink2", ground: "errorBg" },
  refused: { lines: [[0, 8, 8, 0]], ink: "error", ground: "errorBg", width: 2.4 },
  deleted: { lines: [[0, 8, 8, 0], [0, 0, 8, 8]], ink: "ink2", ground: "staleBg" },
  uncovered: { lines: [[0, 0, 8, 8]], ink: "ink2", ground: "shade" },
  waiting: { dots: [[2, 2], [6, 6]], ink: "accent", ground: "shade" },
  to_come: { dots: [[2, 2], [6, 6]], ink: "ink2", ground: "shade" },
};

/**
 * Hatch a stretch over the whole height.
 * @param {import("./draw.js").Frame} frame @param {import("./gaps.js").Hole} hole
 * @param {{colours: any, own: string, patterns: Map<string, CanvasPattern>}} look `own` is the
 *   colour of the variable of which it is, where several have their own gaps
 */
export function drawStretch(frame, { from, to, kind }, look) {
  const { context, dpr } = frame;
  const [left, right] = [Math.max(xOf(frame, from), frame.left), Math.min(xOf(frame, to), frame.left + frame.width)];
  if (right <= frame.left || left >= frame.left + frame.width) return;
  const hatch = HATCHES[kind];
  const ink = look.own || look.colours[hatch.ink];
  const width = Math.max(right - left, LEAST_PX * dpr);
  context.save();
  if (hatch.ground && !look.own) fill(context, look.colours[hatch.ground], 1, left, frame.top, width, frame.height);
  fill(context, patternOf(context, kind, ink, dpr, look.patterns), 1, left, frame.top, width, frame.height);
  if (hatch.ground) edges(frame, ink, left, width);
  context.restore();
}

/** Draw the lines at both ends and the cap. */
function edges({ context, top, height, dpr }, ink, left, width) {
  for (const x of [left, left + width - dpr]) fill(context, ink, 0.6, x, top, dpr, height);
  const cap = Math.max(width, LEAST_CAP_PX * dpr);
  fill(context, ink, 0.75, left - (cap - width) / 2, top, cap, CAP_PX * dpr);
}

function fill(context, style, alpha, ...box) {
  context.globalAlpha = alpha;
  context.fillStyle = style;
  context.fillRect(...box);
}

/** Make a pattern of hatching, once. */
function patternOf(context, kind, ink, dpr, known) {
  const key = `${kind} ${ink} ${dpr}`;
  if (!known.has(key)) known.set(key, context.createPattern(tileOf(HATCHES[kind], ink, dpr), "repeat"));
  return known.get(key);
}

function tileOf({ lines = [], dots = [], width = 1.2 }, ink, dpr) {
  const tile = document.createElement("canvas");
  tile.width = tile.height = TILE_PX * Math.max(1, Math.round(dpr));
  const pen = tile.getContext("2d");
  pen.scale(tile.width / TILE_PX, tile.height / TILE_PX);
  pen.strokeStyle = pen.fillStyle = ink;
  pen.globalAlpha = 0.5;
  pen.lineWidth = width;
  pen.beginPath();
  for (const [x1, y1, x2, y2] of lines) {
    pen.moveTo(x1, y1);
    pen.lineTo(x2, y2);
  }
  pen.stroke();
  for (const [x, y] of dots) pen.fillRect(x - 0.75, y - 0.75, 1.5, 1.5);
  return tile;
}
