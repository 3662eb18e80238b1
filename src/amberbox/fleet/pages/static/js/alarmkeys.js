// Going through the list of alarms by keys, while one does not write.

import { all, one } from "./dom.js";

const WRITES = "input:not([type=checkbox]), select, textarea, [contenteditable], dialog";
const rows = () => all("#alarms .alarm");
const here = { id: null };

/** Return the line that one is at. */
const at = () => document.activeElement?.closest("#alarms .alarm") ?? null;

function go(step) {
  const list = rows();
  if (list.length === 0) return;
  const now = list.indexOf(at() ?? one(`#alarms .alarm[data-alarm="${here.id}"]`));
  const next = now < 0 ? (step > 0 ? 0 : list.length - 1) : Math.min(Math.max(now + step, 0), list.length - 1);
  list[next].focus();
}

/** After the list came anew: be at the alarm where one was, wherever it stands now. */
export function stay() {
  const isLost = document.activeElement === document.body || at() !== null;
  if (here.id === null || !isLost || at()?.dataset.alarm === here.id) return;
  const row = one(`#alarms .alarm[data-alarm="${here.id}"]`);
  if (row) row.focus({ preventScroll: true });
  else if (at() === null) here.id = null;
}

/**
 * Listen to keys.
 * @param {{acknowledge: (row: HTMLElement) => void, choose: (row: HTMLElement) => void}} deeds
 */
export function start({ acknowledge, choose }) {
  const moves = { j: 1, k: -1, ArrowDown: 1, ArrowUp: -1 };
  const deeds = {
    o: (row) => one(".alarm-title a", row).click(),
    a: (row) => one("[data-acknowledge]", row) && acknowledge(row),
    x: choose,
  };

  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest(WRITES)) return;
    const row = at();
    if (event.key in moves && (event.key.length === 1 || row)) go(moves[event.key]);
    else if (event.key in deeds && row) deeds[event.key](row);
    else if (event.key === "Enter" && event.target === row) deeds.o(row);
    else return;
    event.preventDefault();
  });
  document.addEventListener("focusin", () => {
    here.id = at()?.dataset.alarm ?? (document.activeElement === document.body ? here.id : null);
  });
}
