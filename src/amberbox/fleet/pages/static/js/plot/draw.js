/**
 * What panels draw with: lines, steps, bands of envelopes, dots.
 *
 * A `Frame` says where values lie on the canvas; all lengths are pixels of the canvas.
 *
 * @typedef {object} Frame
 * @property {CanvasRenderingContext2D} context
 * @property {number} left @property {number} top @property {number} width @property {number} height
 * @property {number} from @property {number} to seconds at the left and the right edge
 * @property {number} low @property {number} high values at the lower and the upper edge
 * @property {number} dpr pixels of the canvas per pixel of the page
 */

import { firstFrom } from "./data.js";

const DOTS_EVERY_PX = 9;
const DASH = [5, 4];

/** @param {Frame} frame */
export const xOf = (frame, time) =>
  frame.left + ((time - frame.from) / (frame.to - frame.from)) * frame.width;

/** @param {Frame} frame */
const yOf = (frame, value) =>
  frame.top + (1 - (value - frame.low) / (frame.high - frame.low)) * frame.height;

/**
 * Draw a variable.
 * @param {Frame} frame
 * @param {import("./data.js").Series} series
 * @param {{colour: string, steps: boolean, breaks: {from: number, to: number}[], strong: boolean,
 *   sure: ?{from: number, to: number}}} look `sure` is from when to when it is known what is missing
 */
export function drawSeries(frame, series, look) {
  const { context, dpr } = frame;
  context.save();
  context.beginPath();
  context.rect(frame.left, frame.top, frame.width, frame.height);
  context.clip();
  context.strokeStyle = context.fillStyle = look.colour;
  context.lineWidth = (look.strong ? 2.6 : 1.4) * dpr;
  context.lineJoin = "round";
  const [first, end] = shown(frame, series);
  if (series.envelope) drawBand(frame, series, first, end);
  if (!(series.envelope && look.steps)) drawLine(frame, series, look, first, end);
  if (!series.envelope) drawDots(frame, series, first, end);
  context.restore();
}

/** Draw a line over the whole height. @param {Frame} frame */
export function drawMoment(frame, time, colour) {
  const x = Math.round(xOf(frame, time)) + 0.5;
  if (x < frame.left || x > frame.left + frame.width) return;
  const { context } = frame;
  context.save();
  context.strokeStyle = colour;
  context.lineWidth = frame.dpr;
  context.setLineDash([2 * frame.dpr, 3 * frame.dpr]);
  context.beginPath();
  context.moveTo(x, frame.top);
  context.lineTo(x, frame.top + frame.height);
  context.stroke();
  context.restore();
}

/** The places of rows that are within, and one more at each side. */
function shown(frame, { x }) {
  return [Math.max(firstFrom(x, frame.from) - 1, 0), Math.min(firstFrom(x, frame.to) + 1, x.length)];
}

/** Draw what lies between least and greatest values: a spike of one row is in it. */
function drawBand(frame, series, first, end) {
  const { context } = frame;
  const half = series.step / 2;
  for (const [start, stop] of stretches(series, first, end)) {
    context.beginPath();
    for (let n = start; n < stop; n++) {
      context.lineTo(xOf(frame, series.x[n] + half), yOf(frame, series.high[n]));
    }
    for (let n = stop - 1; n >= start; n--) {
      context.lineTo(xOf(frame, series.x[n] + half), yOf(frame, series.low[n]));
    }
    context.closePath();
    context.globalAlpha = 0.28;
    context.fill();
    context.globalAlpha = 0.6;
    context.save();
    context.lineWidth = frame.dpr;
    context.stroke();
    context.restore();
    context.globalAlpha = 1;
  }
}

/** Parts of a series between which there is nothing. */
function* stretches(series, first, end) {
  let start = -1;
  for (let n = first; n <= end; n++) {
    const there = n < end && !Number.isNaN(series.low[n]);
    const far = start >= 0 && n < end && series.x[n] - series.x[n - 1] > series.silence;
    if (start >= 0 && (!there || far)) yield [start, n];
    if (!there) start = -1;
    else if (start < 0 || far) start = n;
  }
}

function drawLine(frame, series, look, first, end) {
  const solid = new Path2D();
  const held = new Path2D();
  let last = -1;
  for (let n = first; n < end; n++) {
    if (Number.isNaN(series.mean[n])) {
      last = -1;
      continue;
    }
    join(frame, series, look, solid, held, last, n);
    last = n;
  }
  frame.context.stroke(solid);
  frame.context.setLineDash(DASH.map((px) => px * frame.dpr));
  frame.context.stroke(held);
  frame.context.setLineDash([]);
}

/** Go on with a line from one row to the next: straight, in a step, held over silence, or not. */
function join(frame, series, look, solid, held, last, n) {
  const half = series.step / 2;
  const x = xOf(frame, series.x[n] + half);
  const y = yOf(frame, series.mean[n]);
  const isSilent = last >= 0 && series.x[n] - series.x[last] > series.silence;
  if (last < 0 || isBroken(look.breaks, series.x[last], series.x[n])
      || (isSilent && !isSure(frame, look.sure, series.x[last], series.x[n]))) {
    solid.moveTo(x, y);
    return;
  }
  const before = yOf(frame, series.mean[last]);
  if (isSilent) {
    held.moveTo(xOf(frame, series.x[last] + half), before);
    held.lineTo(x, before);
    solid.moveTo(x, before);
  } else if (look.steps) {
    solid.lineTo(x, before);
  }
  solid.lineTo(x, y);
}

/** Tell whether there is nothing between two times, and it is known why. */
function isBroken(breaks, from, to) {
  return breaks.some((gap) => gap.from < to && gap.to > from);
}

/** Tell whether it is known of what one sees between two times that nothing is missing there. */
function isSure(frame, sure, from, to) {
  return sure !== null && Math.max(from, frame.from) >= sure.from && Math.min(to, frame.to) <= sure.to;
}

/** Where rows are far apart each is seen. */
function drawDots(frame, series, first, end) {
  const room = frame.width / frame.dpr / DOTS_EVERY_PX;
  if (end - first > room) return;
  const { context } = frame;
  const radius = 2.2 * frame.dpr;
  context.beginPath();
  for (let n = first; n < end; n++) {
    if (Number.isNaN(series.low[n])) continue;
    const x = xOf(frame, series.x[n]);
    const y = yOf(frame, series.low[n]);
    context.moveTo(x + radius, y);
    context.arc(x, y, radius, 0, 2 * Math.PI);
  }
  context.fill();
}
