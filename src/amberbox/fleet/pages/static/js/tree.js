// A tree of rows that one can walk through with the keys: arrows, Home, End, letters. It stands in
// an element that stays, whatever is put in place of the rows.

import { all, one } from "./dom.js";

const TYPED_MS = 600;
const ROWS = ".tr[aria-level]";

/**
 * Make the rows below `place` a tree. `toggled()` is called after somebody opened or closed one.
 * Returns `open(row, isOpen)`, `go(row)`, `opened()`, the names of the open branches, and
 * `tabbable()`, to be called after rows were hidden or replaced.
 * @param {HTMLElement} place
 * @param {{toggled: () => void}} about
 */
export function tree(place, { toggled }) {
  const typed = { text: "", ms: 0 };

  function rows() {
    return all(ROWS, place).filter((row) => !row.closest("[hidden]"));
  }

  function open(row, isOpen) {
    row.setAttribute("aria-expanded", String(isOpen));
    one(".inside", row.parentElement).hidden = !isOpen;
  }

  function toggle(row) {
    open(row, row.getAttribute("aria-expanded") !== "true");
    tabbable();
    toggled();
  }

  /** Put the focus on a row, which becomes the one that Tab leads to. */
  function go(row) {
    if (!row) return;
    mark(row);
    row.focus();
  }

  function mark(row) {
    for (const other of all(`${ROWS}[tabindex="0"]`, place)) other.tabIndex = -1;
    row.tabIndex = 0;
  }

  /** Let Tab lead to a row that is seen: to the first one, if that of before is hidden now. */
  function tabbable() {
    const known = rows();
    if (known.length && !known.some((row) => row.tabIndex === 0)) mark(known[0]);
  }

  function inward(row) {
    const state = row.getAttribute("aria-expanded");
    if (state === "false") toggle(row);
    else if (state === "true") step(row, 1);
  }

  function outward(row) {
    if (row.getAttribute("aria-expanded") === "true") {
      toggle(row);
      return;
    }
    const before = rows().slice(0, rows().indexOf(row)).reverse();
    go(before.find((other) => other.ariaLevel < row.ariaLevel));
  }

  function step(row, by) {
    const known = rows();
    go(known[known.indexOf(row) + by]);
  }

  /** Go to the next row whose name begins with what was typed. */
  function find(row, letter) {
    const now = performance.now();
    typed.text = (now - typed.ms < TYPED_MS ? typed.text : "") + letter.toLowerCase();
    typed.ms = now;
    const known = rows();
    const at = known.indexOf(row) + (typed.text.length === 1 ? 1 : 0);
    const order = [...known.slice(at), ...known.slice(0, at)];
    go(order.find((other) => one(".name", other)?.textContent.trim().toLowerCase().startsWith(typed.text)));
  }

  const keys = {
    ArrowDown: (row) => step(row, 1),
    ArrowUp: (row) => step(row, -1),
    ArrowRight: inward,
    ArrowLeft: outward,
    Home: () => go(rows()[0]),
    End: () => go(rows().at(-1)),
    Enter: (row) => row.hasAttribute("aria-expanded") && toggle(row),
    " ": (row) => row.hasAttribute("aria-expanded") && toggle(row),
  };

  function onKey(event) {
    const row = event.target;
    if (!row.matches(ROWS) || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key in keys) keys[event.key](row);
    else if (event.key.length === 1) find(row, event.key);
    else return;
    event.preventDefault();
  }

  place.addEventListener("keydown", onKey);
  place.addEventListener("focusin", (event) => {
    if (event.target.matches(ROWS)) mark(event.target);
  });
  place.addEventListener("click", (event) => {
    const row = event.target.closest(`${ROWS}[aria-expanded]`);
    if (row && !event.target.closest("a, button")) toggle(row);
  });

  const opened = () => all('[aria-expanded="true"]', place).map((row) => row.parentElement.dataset.component);
  return { open, go, opened, tabbable };
}
