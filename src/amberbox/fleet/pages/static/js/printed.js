// What paper has to say by itself: when it was printed, by whom, from which address, of which time.

import { one, setText } from "./dom.js";
import { t } from "./strings.js";
import { local, nowMs } from "./time.js";

/** Fill in those lines each time somebody prints. */
export function start() {
  addEventListener("beforeprint", () => {
    const line = one("[data-printed]");
    if (line) setText(line, t("common.printed", { at: moment(nowMs()), who: line.dataset.printed, address: location.href }));
    const window = one("[data-printed-window]");
    if (window) setText(window, windowWords(window.dataset));
  });
}

/** Say a window as the fields of the page have it; they hold times of the viewer's zone. */
function windowWords({ from, to }) {
  const [begin, end] = [from, to].map((field) => Date.parse(one(field).value));
  if (Number.isNaN(begin) || Number.isNaN(end)) return "";
  return t("common.printed_window", { from: moment(begin), to: moment(end), zone: Intl.DateTimeFormat().resolvedOptions().timeZone });
}

/** @param {number} ms */
function moment(ms) {
  return `${local(ms, "date")}, ${local(ms, "time")}`;
}
