// Going through the list of alarms by keys, while one does not write.

import { all, one } from "../dom.js";

const WRITES = "input:not([type=checkbox]), select, textarea, [contenteditable], dialog";
const rows = () => all("#alarms .alarm");
const here = { id: null, place: 0 };

/** Return the line that one is at. */
const at = () => document.activeElement?.closest("#alarms .alarm") ?? null;

/** Note where one went by oneself: not where the focus falls when the list comes anew. */
function note() {
  const row = at();
  if (row) Object.assign(here, { id: row.dataset.alarm, place: rows().indexOf(row) });
  else if (document.activeElement !== document.body) here.id = null;
}

function go(step) {
  const list = rows();
  if (list.length === 0) return;
  const now = list.indexOf(at() ?? one(`#alarms .alarm[data-alarm="${here.id}"]`));
  const next = now < 0 ? (step > 0 ? 0 : list.length - 1) : Math.min(Math.max(now + step, 0), list.length - 1);
  list[next].focus();
  note();
}

/** After the list came anew: be at the alarm where one was; if it is gone, at the next one. */
export function stay() {
  const isMine = document.activeElement === document.body || at() !== null;
  if (here.id === null || !isMine) return;
  const list = rows();
  const row = list.find((one) => one.dataset.alarm === here.id) ?? list[Math.min(here.place, list.length - 1)];
  if (row && !row.contains(document.activeElement)) row.focus({ preventScroll: true });
  note();
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
  for (const kind of ["keyup", "pointerup"]) document.addEventListener(kind, note);
}
