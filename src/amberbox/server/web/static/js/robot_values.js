// Levels, values and ages of a robot: written straight from the feed, several times a second.

import { el, find, findAll, levelBadge, setText, setTextAttribute } from "./dom.js";
import { t } from "./strings.js";
import { durationText, localTime, nowMs, timeElement, UNITS } from "./time.js";

/** @type {Record<string, (value: unknown, expected: unknown) => boolean>} */
const COMPARISONS = {
  "!=": (value, expected) => value !== expected,
  ">=": (value, expected) => value >= expected,
  "<=": (value, expected) => value <= expected,
  ">": (value, expected) => value > expected,
  "<": (value, expected) => value < expected,
};

/**
 * Tell whether a value is as expected, as `is_met` of the server does. Without an expectation or a
 * value it is. @param {string} expected @param {unknown} value
 */
export function isAsExpected(expected, value) {
  if (!expected || value === null || value === undefined) return true;
  const isNumber = typeof value === "number";
  const ends = expected.split(" to ");
  if (isNumber && ends.length === 2) return Number(ends[0]) <= value && value <= Number(ends[1]);
  const [, relation, rest] = /^(\S+) (.+)$/s.exec(expected) ?? [];
  const compare = COMPARISONS[relation] ?? ((one, other) => one === other);
  const limit = relation in COMPARISONS ? rest : expected;
  return compare(isNumber ? value : String(value), isNumber ? Number(limit) : limit);
}

const DIGITS = 4;
// durations from 2 min are written in two units, up to those that mean "never"
const [TWO_UNITS_S, FOREVER_S] = [120, 1e9];

/** Return the key of an element that shows a status or value, as the server writes it. */
const rowKey = (component, mode = "", output = "") => [component, mode, output].map(encodeURIComponent).join("/");

/** Write a number with four significant digits, as the server does. @param {number} value */
export function numberText(value) {
  const size = Math.abs(value);
  if (!Number.isFinite(value) || size >= 1e6 || (size > 0 && size < 1e-3)) return value.toExponential(2).replace(/e([+-])(\d)$/, "e$10$2");
  const whole = size >= 1 ? Math.floor(Math.log10(size)) : 0;
  return value.toFixed(Math.max(0, DIGITS - 1 - whole));
}

/** Write a duration, as the server does: in two units from 2 min. @param {number} value seconds */
function twoUnitDuration(value) {
  const whole = Math.floor(Math.abs(value));
  if (!(Math.abs(value) >= TWO_UNITS_S && Math.abs(value) < FOREVER_S)) return `${numberText(value)} s`;
  const place = UNITS.findIndex(([, size]) => whole >= size);
  const [[most, size], next] = [UNITS[place], UNITS[place + 1]];
  const parts = [[most, Math.floor(whole / size)], ...(next ? [[next[0], Math.floor((whole % size) / next[1])]] : [])];
  const text = parts.filter(([, n]) => n).map(([name, n]) => t(`common.span.${name}`, { n })).join(" ");
  return value < 0 ? `-${text}` : text;
}

/** Write a value of an output. @param {unknown} value @param {string} type */
function valueText(value, type) {
  if (value === null || value === undefined) return t("robot.value.none");
  if (typeof value === "boolean") return t(value ? "robot.value.yes" : "robot.value.no");
  if (typeof value === "number" && type === "duration") return twoUnitDuration(value);
  return typeof value === "number" && type === "float" ? numberText(value) : String(value);
}

/**
 * Return functions that write below `page`: `write(statuses)`, `takeAges(ages)`, `tick()`, and
 * `index()`, to be called after elements were replaced.
 * @param {HTMLElement} page
 */
export function robotValues(page) {
  /** @type {Map<string, {row: HTMLElement, level: Element, why: Element, age: HTMLElement}>} */
  const rows = new Map();
  /** @type {Map<string, HTMLElement[]>} */
  const cells = new Map();
  /** @type {Map<string, HTMLElement[]>} */
  const levels = new Map();
  /** When each status was measured, in ms by the server's clock. @type {Map<string, number>} */
  const measuredMs = new Map();

  function index() {
    for (const map of [rows, cells, levels]) map.clear();
    for (const element of findAll("[data-k]", page)) addElement(element);
    for (const element of findAll("[data-level-of]", page)) addTo(levels, element.dataset.levelOf, element);
  }

  function addElement(element) {
    const { k } = element.dataset;
    const age = find(".age", element);
    if (!age) {
      addTo(cells, k, element);
      return;
    }
    rows.set(k, { row: element, level: find(".level", element), why: find(".why", element), age });
    if (age.dataset.age && !measuredMs.has(k)) measuredMs.set(k, nowMs() - 1000 * Number(age.dataset.age));
  }

  /** Write statuses; false if the page has no element for one: the tree has changed. */
  function write(statuses) {
    return statuses.map(writeStatus).every(Boolean);
  }

  function writeStatus(status) {
    const k = rowKey(status.component, status.mode);
    const entry = rows.get(k);
    if (!entry) return false;
    measuredMs.set(k, nowMs() - 1000 * (status.age_s ?? 0));
    setLevel(entry.level, status.level);
    const why = status.level === "ok" ? "" : status.reason || status.state.replaceAll("_", " ");
    setText(entry.why, why);
    setTextAttribute(entry.why, "title", status.reason);
    if (!status.mode) writeComponent(entry.row.parentElement, status, k);
    else if (status.level !== "ok") showRow(entry.row);
    return Object.entries(status.outputs).every(([name, value]) => writeValue(status, name, value));
  }

  function writeComponent(branch, status, k) {
    branch.dataset.level = status.level;
    for (const element of levels.get(k) ?? []) setLevel(find(".level", element), status.level);
    const blockers = find("[data-blockers]", branch);
    const names = status.blocked_by.join("\n");
    if (blockers.dataset.blockers !== names) {
      blockers.dataset.blockers = names;
      blockers.replaceChildren(...(status.blocked_by.length ? withCommas(status.blocked_by.map(componentLink)) : [t("robot.nothing")]));
    }
    const since = find("[data-since] time", branch);
    if (since && status.since && since.dateTime !== status.since) since.replaceWith(timeElement(status.since));
  }

  function writeValue(status, name, value) {
    const cellsOf = cells.get(rowKey(status.component, status.mode, name));
    for (const element of cellsOf ?? []) {
      const cell = find(".val", element);
      setText(cell, valueText(value, cell.dataset.type));
      markUnexpected(element, status.level !== "ok", status.state === name, value);
    }
    return cellsOf !== undefined;
  }

  /** Set the ages of statuses: most are as old as the newest, the older ones are listed. */
  function takeAges({ age_s: newestAge, older }) {
    const now = nowMs();
    const old = new Map(older.map(([component, mode, age]) => [rowKey(component, mode), age]));
    for (const k of measuredMs.keys()) measuredMs.set(k, now - 1000 * (old.get(k) ?? newestAge));
  }

  /** Write all ages; of a silent robot the times at which its statuses were measured. */
  function tick(isSilent = false) {
    const now = nowMs();
    for (const [k, { age }] of rows) {
      const at = measuredMs.get(k);
      if (at !== undefined) setText(age, isSilent ? localTime(at, "time") : durationText(Math.max(1, (now - at) / 1000)));
    }
  }

  /** Return the age of the newest status, in s; null for none. */
  function newestAge() {
    return measuredMs.size ? (nowMs() - Math.max(...measuredMs.values())) / 1000 : null;
  }

  index();
  return { index, write, takeAges, tick, newestAge };
}

function addTo(map, name, element) {
  map.set(name, [...(map.get(name) ?? []), element]);
}

/** Write a level into the element that shows one. */
function setLevel(element, name) {
  if (element.dataset.level === name) return;
  const fresh = levelBadge(name, t(`common.level.${name}`));
  element.className = fresh.className;
  element.dataset.level = name;
  element.replaceChildren(...fresh.childNodes);
}

/** Mark a value that is the reason why its mode fails, also while it is as expected again. */
function markUnexpected(element, isFailing, isCause, value) {
  const { expected = "" } = element.dataset;
  const isMet = isAsExpected(expected, value);
  const isWrong = isFailing && (isCause || !isMet);
  const isRecovering = isWrong && isMet && expected !== "";
  element.classList.toggle("wrong", isWrong);
  element.classList.toggle("again", isRecovering);
  const healing = find(".healing", element);
  if (healing && healing.hidden === isRecovering) healing.hidden = !isRecovering;
  if (isWrong) showRow(element);
}

/** Show a check that was hidden because it held. */
function showRow(row) {
  if (row.hidden) row.hidden = false;
}

function componentLink(id) {
  const name = find(`.branch[data-component="${CSS.escape(id)}"] .node .name b`)?.textContent;
  return el("a", { href: `#c-${encodeURIComponent(id)}`, "data-go": id }, name ?? id.replaceAll("_", " "));
}

function withCommas(links) {
  return links.flatMap((link, n) => (n ? [", ", link] : [link]));
}
