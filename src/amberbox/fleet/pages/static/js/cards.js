// Tables as cards where there is no room: each value gets the title of its column, which the style
// sheet shows before it on narrow screens. One look at the head serves tables of all pages.

import { all, one, setWords } from "./dom.js";

const ROLES = [["thead, tbody", "rowgroup"], ["tr", "row"], ["thead th", "columnheader"], ["tbody th", "rowheader"], ["td", "cell"]];

/**
 * Label the values of all tables in `root`. Tables with values across columns stay as they are.
 * @param {ParentNode} root
 */
export function label(root = document) {
  for (const table of all("table.table", root)) {
    const heads = all("thead th", table).map(title);
    if (heads.length > 1 && !one("[colspan], [rowspan]", table)) mark(table, heads);
  }
}

/** Return the title of a column; none where only those hear it who cannot see the column. */
function title(head) {
  return head.querySelector(":scope > .sr-only") ? "" : head.textContent.trim().replace(/\s+/g, " ");
}

/** Styled as blocks a table is none any more for some browsers: its parts say what they are. */
function mark(table, heads) {
  table.dataset.cards = "";
  table.setAttribute("role", "table");
  for (const [selector, role] of ROLES) {
    for (const part of all(selector, table)) part.setAttribute("role", role);
  }
  for (const row of all("tbody tr", table)) {
    [...row.children].forEach((cell, at) => heads[at] && setWords(cell, "data-label", heads[at]));
  }
}
