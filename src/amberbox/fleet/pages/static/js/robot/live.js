// What changes many times a second on a robot's page: levels, values, ages. Each is written where
// it stands, found by its key; nothing is fetched, and nothing moves.

import { all, el, level as levelOf, one, setText, setWords } from "../dom.js";
import { isMet } from "./expected.js";
import { t } from "../strings.js";
import { local, nowMs, span, when } from "../time.js";

const DIGITS = 4;
const [LONG_S, FOREVER_S] = [120, 1e9];
const SPANS = [["d", 86400], ["h", 3600], ["min", 60], ["s", 1]];

/** Return the name by which something is found: as tree.py makes it. */
export const key = (component, mode = "", output = "") => [component, mode, output].map(encodeURIComponent).join("/");

/** Write a number with four digits that count, as values.py does. @param {number} value */
export function number(value) {
  const size = Math.abs(value);
  if (!Number.isFinite(value) || size >= 1e6 || (size > 0 && size < 1e-3)) return value.toExponential(2).replace(/e([+-])(\d)$/, "e$10$2");
  const whole = size >= 1 ? Math.floor(Math.log10(size)) : 0;
  return value.toFixed(Math.max(0, DIGITS - 1 - whole));
}

/** Write a duration, as values.py does: in two units from 2 min on. @param {number} value seconds */
export function duration(value) {
  const whole = Math.floor(Math.abs(value));
  if (!(Math.abs(value) >= LONG_S && Math.abs(value) < FOREVER_S)) return `${number(value)} s`;
  const place = SPANS.findIndex(([, size]) => whole >= size);
  const [[most, size], next] = [SPANS[place], SPANS[place + 1]];
  const parts = [[most, Math.floor(whole / size)], ...(next ? [[next[0], Math.floor((whole % size) / next[1])]] : [])];
  const text = parts.filter(([, n]) => n).map(([name, n]) => t(`common.span.${name}`, { n })).join(" ");
  return value < 0 ? `-${text}` : text;
}

/** Write a value of an output. @param {unknown} value @param {string} type */
export function shown(value, type) {
  if (value === null || value === undefined) return t("robot.value.none");
  if (typeof value === "boolean") return t(value ? "robot.value.yes" : "robot.value.no");
  if (typeof value === "number" && type === "duration") return duration(value);
  return typeof value === "number" && type === "float" ? number(value) : String(value);
}

/**
 * Write what changes below `page`. `index()` looks anew at what stands there.
 * @param {HTMLElement} page
 */
export function robotLive(page) {
  /** @type {Map<string, {row: HTMLElement, level: Element, why: Element, age: HTMLElement, mode: boolean}>} */
  const rows = new Map();
  /** @type {Map<string, HTMLElement[]>} */
  const cells = new Map();
  /** @type {Map<string, HTMLElement[]>} */
  const levels = new Map();
  /** When each was measured, by the server's clock in ms. @type {Map<string, number>} */
  const measured = new Map();

  function index() {
    for (const map of [rows, cells, levels]) map.clear();
    for (const element of all("[data-k]", page)) enter(element);
    for (const element of all("[data-level-of]", page)) add(levels, element.dataset.levelOf, element);
  }

  function enter(element) {
    const { k } = element.dataset;
    const age = one(".age", element);
    if (!age) {
      add(cells, k, element);
      return;
    }
    rows.set(k, { row: element, level: one(".level", element), why: one(".why", element), age, mode: element.matches(".mode") });
    if (age.dataset.age && !measured.has(k)) measured.set(k, nowMs() - 1000 * Number(age.dataset.age));
  }

  /** Write statuses; false where one has no place here: then the tree is another one. */
  function write(statuses) {
    return statuses.map(writeOne).every(Boolean);
  }

  function writeOne(said) {
    const k = key(said.component, said.mode);
    const known = rows.get(k);
    if (!known) return false;
    measured.set(k, nowMs() - 1000 * (said.age_s ?? 0));
    setLevel(known.level, said.level);
    const why = said.level === "ok" ? "" : said.reason || said.state.replaceAll("_", " ");
    setText(known.why, why);
    setWords(known.why, "title", said.reason);
    if (!said.mode) writeComponent(known.row.parentElement, said, k);
    else if (said.level !== "ok") unfold(known.row);
    return Object.entries(said.outputs).every(([name, value]) => writeValue(said, name, value));
  }

  function writeComponent(branch, said, k) {
    branch.dataset.level = said.level;
    for (const element of levels.get(k) ?? []) setLevel(one(".level", element), said.level);
    const blockers = one("[data-blockers]", branch);
    const names = said.blocked_by.join("\n");
    if (blockers.dataset.blockers !== names) {
      blockers.dataset.blockers = names;
      blockers.replaceChildren(...(said.blocked_by.length ? joined(said.blocked_by.map(link)) : [t("robot.nothing")]));
    }
    const since = one("[data-since] time", branch);
    if (since && said.since && since.dateTime !== said.since) since.replaceWith(when(said.since));
  }

  function writeValue(said, name, value) {
    const found = cells.get(key(said.component, said.mode, name));
    for (const element of found ?? []) {
      const cell = one(".val", element);
      setText(cell, shown(value, cell.dataset.type));
      judge(element, said.level !== "ok", said.state === name, value);
    }
    return found !== undefined;
  }

  /** Take what the server says about ages. */
  function take({ age_s: newest, older }) {
    const now = nowMs();
    const old = new Map(older.map(([component, mode, age]) => [key(component, mode), age]));
    for (const k of measured.keys()) measured.set(k, now - 1000 * (old.get(k) ?? newest));
  }

  /**
   * Write all ages: they count on, whether something comes or not. Of a robot that is away or
   * silent it is written as of when each was measured.
   */
  function tick(isSilent = false) {
    const now = nowMs();
    for (const [k, { age }] of rows) {
      const at = measured.get(k);
      if (at !== undefined) setText(age, isSilent ? local(at, "time") : span(Math.max(1, (now - at) / 1000)));
    }
  }

  /** Return how old the newest of all is, in s; null where nothing was measured. */
  function newest() {
    return measured.size ? (nowMs() - Math.max(...measured.values())) / 1000 : null;
  }

  index();
  return { index, write, take, tick, newest };
}

function add(map, name, element) {
  map.set(name, [...(map.get(name) ?? []), element]);
}

/** Write a level into the element that shows one. */
function setLevel(element, name) {
  if (element.dataset.level === name) return;
  const fresh = levelOf(name, t(`common.level.${name}`));
  element.className = fresh.className;
  element.dataset.level = name;
  element.replaceChildren(...fresh.childNodes);
}

/** Mark a value that its mode is not well for, also while it is as expected again. */
function judge(element, isIll, isNamed, value) {
  const { expected = "" } = element.dataset;
  const met = isMet(expected, value);
  const isWrong = isIll && (isNamed || !met);
  const isAgain = isWrong && met && expected !== "";
  element.classList.toggle("wrong", isWrong);
  element.classList.toggle("again", isAgain);
  const healing = one(".healing", element);
  if (healing && healing.hidden === isAgain) healing.hidden = !isAgain;
  if (isWrong) unfold(element);
}

/** Show a row that was folded because it held. */
function unfold(row) {
  if (row.hidden) row.hidden = false;
}

function link(id) {
  const called = one(`.branch[data-component="${CSS.escape(id)}"] .node .name b`)?.textContent;
  return el("a", { href: `#c-${encodeURIComponent(id)}`, "data-go": id }, called ?? id.replaceAll("_", " "));
}

function joined(links) {
  return links.flatMap((one, place) => (place ? [", ", one] : [one]));
}
