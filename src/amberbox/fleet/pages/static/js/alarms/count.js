// How many alarms are open: at the top of every page, and in the title that the browser shows.
//
// It is asked for anew when the feed of the page tells of an alarm, and now and then on pages that
// have none.

import { one } from "../dom.js";
import { keep } from "../pieces.js";

const EVERY_MS = 60000;
const CALM_MS = 1000;

const shown = () => one("[data-alarm-count]");

/** Put the number before the title of the page. */
function mark() {
  const count = Number(shown()?.dataset.alarmCount ?? 0);
  const plain = document.title.replace(/^\(\d+\) /, "");
  const title = count > 0 ? `(${count}) ${plain}` : plain;
  if (document.title !== title) document.title = title;
}

if (shown()) {
  const stale = keep(shown, () => "/pieces/alarm-count", CALM_MS, mark);
  mark();
  addEventListener("alarmchange", stale);
  document.addEventListener("visibilitychange", () => document.hidden || stale());
  setInterval(() => document.hidden || stale(), EVERY_MS);
}
