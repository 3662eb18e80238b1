/** Times as people write them into addresses and fields. All times are seconds since 1970. */

import { seconds } from "./plot/data.js";
import { fieldText as fieldTextMs, rfc3339 } from "./time.js";

const UNITS = { ns: 1e-9, us: 1e-6, ms: 1e-3, s: 1, m: 60, min: 60, h: 3600, d: 86400 };
const PART = /(\d+(?:\.\d+)?)(ns|us|ms|min|s|m|h|d)/g;
const BIG = [[1e11, 1], [1e14, 1e3], [1e17, 1e6], [Infinity, 1e9]];

/**
 * Read a time: RFC 3339 (without a zone UTC), an epoch, `now`, `now-1h`, or `-10m` before the last
 * record. Null for what is none.
 * @param {string} text @param {{now: number, last: ?number}} marks
 */
export function timeOf(text, { now, last }) {
  const plain = text.trim();
  const moved = /^(now|)([+-].+)?$/.exec(plain);
  if (plain && moved) return shifted(moved[1] ? now : last, moved[2]);
  if (/^\d+(\.\d+)?$/.test(plain)) return Number(plain) / BIG.find(([limit]) => Number(plain) < limit)[1];
  const zoned = /(Z|[+-]\d\d:?\d\d)$/i.test(plain) ? plain : `${plain}Z`;
  const found = /^\d{4}-\d\d-\d\d[T ]/.test(plain) ? seconds(zoned.replace(" ", "T")) : seconds(plain);
  return Number.isNaN(found) ? null : found;
}

function shifted(from, by) {
  if (from === null || !by) return from;
  const parts = [...by.slice(1).matchAll(PART)];
  if (parts.map(([whole]) => whole).join("") !== by.slice(1)) return null;
  const length = parts.reduce((sum, [, number, unit]) => sum + Number(number) * UNITS[unit], 0);
  return by[0] === "-" ? from - length : from + length;
}

/** Write a time for an address or the API. @param {number} time */
export const stamp = (time) => rfc3339(Math.round(time * 1000));

/** Write a time for a field of the type datetime-local, in the viewer's zone. @param {number} time */
export const fieldText = (time) => fieldTextMs(time * 1000);

/** Read such a field; null for an empty one. @param {string} text */
export function fieldTime(text) {
  const ms = new Date(text).getTime();
  return Number.isNaN(ms) ? null : ms / 1000;
}
