// Which alarms are chosen for one answer to all of them.

import { all, one, setText } from "../dom.js";
import { t } from "../strings.js";

const boxes = () => all("#alarms [data-choose]");

/**
 * Remember what is chosen while the list changes; the bar is there while something is.
 * @param {HTMLFormElement} bar
 */
export function chosen(bar) {
  const ids = new Set();

  /** Show what is chosen; what is not in the list any more is not. */
  function show() {
    const there = new Set(boxes().map((box) => box.value));
    for (const id of ids) if (!there.has(id)) ids.delete(id);
    for (const box of boxes()) box.checked = ids.has(box.value);
    const every = one("[data-choose-all]");
    if (every) every.checked = ids.size > 0 && ids.size === there.size;
    if (every) every.indeterminate = ids.size > 0 && ids.size < there.size;
    bar.hidden = ids.size === 0;
    setText(one("[data-chosen]", bar), t("alarms.chosen", { n: ids.size }));
  }

  function set(some, isChosen) {
    for (const id of some) {
      if (isChosen) ids.add(id);
      else ids.delete(id);
    }
    show();
  }

  document.addEventListener("change", ({ target }) => {
    if (target.matches("[data-choose]")) set([target.value], target.checked);
    if (target.matches("[data-choose-all]")) set(boxes().map((box) => box.value), target.checked);
  });
  one("[data-let-go]", bar).addEventListener("click", () => set([...ids], false));

  return {
    show,
    drop: (some) => set(some, false),
    turn: (row) => one("[data-choose]", row) && set([row.dataset.alarm], !ids.has(row.dataset.alarm)),
    rows: () => all("#alarms .alarm").filter((row) => ids.has(row.dataset.alarm)),
  };
}
