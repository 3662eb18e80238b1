/** A variable that is shown: what it is, which colour it has, what its values are called. */

import { t } from "../strings.js";

const COLOURS = 8;
const LEAST_S = 1e-3;

/**
 * Tell how a column is drawn.
 * @param {{type: string, labels: Record<string, string>}} column
 * @returns {"number"|"enum"|"bool"|"text"}
 */
export function kindOf(column) {
  if (Object.keys(column.labels ?? {}).length) return "enum";
  if (column.type === "bool") return "bool";
  return column.type === "string" ? "text" : "number";
}

/**
 * Make a trace of what a page asks to be shown.
 * @param {import("./plot.js").Added} about @param {Set<number>} used colours that are taken
 * @returns {import("./panel.js").Trace}
 */
export function traceOf(about, used) {
  const { id, robot, item, variable, label = variable, unit = "", labels = {}, origin = 0, length = null } = about;
  const kind = about.kind ?? kindOf({ type: "", labels });
  const { codes, names } = namesOf(kind, labels);
  return {
    id, robot, item, variable, label, unit, kind, origin, length, codes, names, panel: about.panel ?? id,
    colour: freeColour(used), series: null, live: null, widest: null, sums: null, problem: null, asked: null,
  };
}

/**
 * The part of a window in which a variable is shown: of a mission only its own time.
 * @param {{length: ?number}} trace @param {import("./view.js").Span} window
 * @returns {import("./view.js").Span}
 */
export function partOf({ length }, { from, to }) {
  if (length === null) return { from, to };
  const end = Math.min(Math.max(to, LEAST_S), Math.max(length, LEAST_S));
  return { from: Math.min(Math.max(from, 0), end - LEAST_S), to: end };
}

/** Values that have names, in order, and the names. */
function namesOf(kind, labels) {
  if (kind === "bool") return { codes: [0, 1], names: [t("plot.no"), t("plot.yes")] };
  if (kind !== "enum") return { codes: [], names: [] };
  const codes = Object.keys(labels).map(Number).sort((one, other) => one - other);
  return { codes, names: codes.map((code) => labels[code]) };
}

function freeColour(used) {
  const free = Array.from({ length: COLOURS }, (_, n) => n).find((n) => !used.has(n));
  return free ?? used.size % COLOURS;
}
