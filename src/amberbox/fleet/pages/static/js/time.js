// Times as the viewer reads them. Ages never believe the viewer's clock: they are counted from the
// server's time as the page came, by a clock that only goes forward.

import { all, setText, setWords } from "./dom.js";
import { t } from "./strings.js";

const TICK_MS = 1000;
const STEPS = [["d", 86400], ["h", 3600], ["min", 60], ["s", 1]];
// the page says when it was made: that was when its first byte came, however long modules take
const loadedMs = performance.getEntriesByType("navigation")[0]?.responseStart || performance.now();
const serverMs = Date.parse(document.querySelector('meta[name="now"]')?.content ?? "") || Date.now();

/** Return the server's time now, in ms since the epoch. */
export const nowMs = () => serverMs + performance.now() - loadedMs;

/** Return a time as RFC 3339. @param {number} ms */
export const rfc3339 = (ms) => new Date(ms).toISOString();

/** Write a time for a field of the type datetime-local, in the viewer's zone. @param {number} ms */
export function fieldText(ms) {
  if (Number.isNaN(ms)) return "";
  return new Date(ms - new Date(ms).getTimezoneOffset() * 60_000).toISOString().slice(0, 19);
}

/** Read such a field as RFC 3339; empty if it is. @param {string} text */
export const fieldStamp = (text) => (text ? rfc3339(Date.parse(text)) : "");

/** Return how long something lasts, in one unit: "5 min". @param {number} seconds */
export function span(seconds) {
  const whole = Math.max(0, Math.floor(seconds));
  const [unit, size] = STEPS.find(([, size]) => whole >= size) ?? ["s", 1];
  return t(`common.span.${unit}`, { n: Math.floor(whole / size) });
}

/** Return how long ago a time is, in words. @param {number} ms */
export function ago(ms) {
  const seconds = (nowMs() - ms) / 1000;
  if (Math.abs(seconds) < 1.5) return t("common.ago.now");
  if (seconds < 0) return t("common.ago.ahead", { text: span(-seconds) });
  const [unit, size] = STEPS.find(([, size]) => seconds >= size) ?? ["s", 1];
  return t(`common.ago.${unit}`, { n: Math.floor(seconds / size) });
}

const styles = {
  time: new Intl.DateTimeFormat(undefined, { hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23" }),
  date: new Intl.DateTimeFormat(undefined, { day: "numeric", month: "short", year: "numeric" }),
  at: new Intl.DateTimeFormat(undefined, {
    day: "numeric", month: "short", hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23",
  }),
};

/** Return a time in the viewer's zone. @param {number} ms @param {"at"|"time"|"date"} as */
export const local = (ms, as = "at") => styles[as].format(ms);

/** Return a time in UTC, for those who compare. @param {number} ms */
const utc = (ms) => t("common.shown_utc", { text: new Date(ms).toISOString().replace("T", " ").slice(0, 23) });

/** Make an element that shows a time and stays right. @param {string} stamp @param {string} as */
export function when(stamp, as = "at") {
  const element = document.createElement("time");
  element.dateTime = stamp;
  element.dataset.as = as;
  write(element);
  return element;
}

/** Write all times below an element anew: after it was changed. */
export function refresh(root = document) {
  for (const element of all("time[data-as]", root)) write(element);
}

function write(element) {
  const ms = Date.parse(element.dateTime);
  if (Number.isNaN(ms)) return;
  const as = element.dataset.as;
  const text = as === "ago" ? ago(ms) : as === "span" ? span((nowMs() - ms) / 1000) : local(ms, as);
  setText(element, text);
  const title = as === "ago" || as === "span" ? `${local(ms)} · ${utc(ms)}` : utc(ms);
  setWords(element, "title", title);
}

function tick() {
  for (const element of all('time[data-as="ago"], time[data-as="span"]')) write(element);
}

setInterval(tick, TICK_MS);
