/**
 * Live values behind what was loaded: appended as they come, five times a second at most. Values
 * that a later answer of the server has as rows are let go.
 */

import { placeOf, seconds } from "./data.js";

const KEPT = 20000;
const SILENCE_S = 5;

/** The name under which the feed tells of a variable. */
export const liveName = (trace) => `${trace.item}.${trace.variable}`;

/** What to ask of the feed. @returns {Record<string, string[]>} robot -> variables */
export function wanted(traces) {
  const found = {};
  for (const trace of traces) {
    found[trace.robot] = [...new Set([...(found[trace.robot] ?? []), liveName(trace)])];
  }
  return found;
}

/** Append what came to the variables it is of; the newest time, null for nothing new. */
export function take(traces, robot, data) {
  let newest = null;
  for (const trace of traces) {
    const came = trace.robot === robot ? data[liveName(trace)] : undefined;
    if (!came?.at) continue;
    const time = seconds(came.at) - trace.origin;
    if (append(trace, time, came.value)) newest = Math.max(newest ?? time, time);
  }
  return newest;
}

/** Let go of live values that were loaded as rows meanwhile, and of too many. */
export function trim(trace) {
  if (!trace.live) return;
  const last = trace.series?.x[trace.series.x.length - 1] ?? -Infinity;
  const lines = rows(trace.live).filter(([time]) => time > last).slice(-KEPT);
  trace.live = lines.length ? made(lines) : null;
}

function append(trace, time, value) {
  const last = trace.live?.x[trace.live.x.length - 1] ?? -Infinity;
  if (time <= last) return false;
  const raw = numberOf(trace, value);
  const place = trace.codes.length ? placeOf(trace.codes, raw) : raw;
  const lines = trace.live ?? made([]);
  lines.x.push(time);
  lines.low.push(place);
  lines.raw.push(raw);
  trace.live = lines;
  return true;
}

function numberOf(trace, value) {
  if (trace.kind !== "text") return value === null ? NaN : Number(value);
  if (value === null) return NaN;
  const known = trace.names.indexOf(String(value));
  return known >= 0 ? known : trace.names.push(String(value)) - 1;
}

function rows({ x, low, raw }) {
  return x.map((time, n) => [time, low[n], raw[n]]);
}

/** @returns {import("./data.js").Series} */
function made(lines) {
  const low = lines.map((line) => line[1]);
  return { x: lines.map((line) => line[0]), low, high: low, mean: low, raw: lines.map((line) => line[2]),
    envelope: false, step: 0, of: lines.length, silence: SILENCE_S, completeTo: null };
}
