/** Times on plots: in the viewer's zone, as exact as the step between labels asks for. */

const DAY_S = 86400;
const ZERO = 48;

/** @param {Intl.DateTimeFormatOptions} options */
const format = (options) => new Intl.DateTimeFormat("en-GB", options);
const MINUTES = format({ hour: "2-digit", minute: "2-digit" });
const SECONDS = format({ hour: "2-digit", minute: "2-digit", second: "2-digit" });
const DATE = format({ day: "numeric", month: "short", year: "numeric" });
const SHORT_DATE = format({ day: "numeric", month: "short" });

/** A time of day, such as 14:03:20.5. @param {number} time @param {number} step seconds */
export function clock(time, step) {
  if (step >= 60) return MINUTES.format(new Date(Math.round(time) * 1000));
  const digits = digitsOf(step);
  const [whole, part] = parted(time, digits);
  return SECONDS.format(new Date(whole * 1000)) + part;
}

/** Labels of an axis; the date stands below the first one and where the day changes. */
export function clockLabels(times, step) {
  let last = "";
  return times.map((time) => {
    const date = new Date(time * 1000);
    const day = SHORT_DATE.format(date);
    const full = last ? day : DATE.format(date);
    const changed = day !== last;
    last = day;
    if (step >= DAY_S) return full;
    return changed ? `${clock(time, step)}\n${full}` : clock(time, step);
  });
}

/** Date and time. @param {number} time @param {number} step seconds that matter */
export function moment(time, step) {
  return `${DATE.format(new Date(time * 1000))}, ${clock(time, Math.min(step, 1))}`;
}

/** The same in UTC, for titles. */
export function utc(time) {
  return `${new Date(time * 1000).toISOString().replace("T", " ").replace("Z", "")} UTC`;
}

/** Time since a beginning, such as 1:03:20.5. */
export function since(time, step) {
  const [whole, part] = parted(Math.abs(time), digitsOf(step));
  const two = (n) => String.fromCharCode(ZERO + Math.floor(n / 10), ZERO + (n % 10));
  const hours = Math.floor(whole / 3600);
  const rest = `${two(Math.floor(whole / 60) % 60)}:${two(whole % 60)}${part}`;
  return `${time < 0 ? "−" : ""}${hours ? `${hours}:` : ""}${rest}`;
}

/** Decimals of seconds that a step needs, up to microseconds. */
function digitsOf(step) {
  return step >= 1 ? 0 : Math.min(6, Math.ceil(-Math.log10(step) - 1e-9));
}

/** Whole seconds, and their fraction as text. */
function parted(time, digits) {
  const scale = 10 ** digits;
  const rounded = Math.round(time * scale);
  const whole = Math.floor(rounded / scale);
  if (!digits) return [whole, ""];
  return [whole, `.${String(rounded - whole * scale).padStart(digits, "0")}`];
}
