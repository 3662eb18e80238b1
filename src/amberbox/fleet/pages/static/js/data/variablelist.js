/**
 * The variables of a robot: which there are, finding one by its name, searching by words.
 *
 * @typedef {object} Variable
 * @property {string} address ITEM.NAME @property {string} item @property {string} name
 * @property {string} path @property {string} type @property {string} unit
 * @property {Record<string, string>} labels
 * @property {?("number"|"enum"|"bool"|"text")} kind how it is drawn; null for what cannot be drawn
 * @property {string} words what is searched
 *
 * @typedef {{name: string, topic: string, type: string, rate: ?number, rows: number, last: ?number,
 *   first: ?number, isOwn: boolean, chosen: string[], variables: Variable[]}} Item
 */

import { ask } from "../ask.js";
import { maybeSeconds } from "../plot/data.js";
import { kindOf } from "../plot/trace.js";

const UNDRAWN = /^(list<|binary|time$|duration$)/;
const TELLING = [/charge|soc\b|percent/i, /volt|battery/i, /wheel|odom|velocity|twist_linear_x|speed/i, /temperature|current/i];
const DULL = /^(timestamp|received|stamp|seq|index)$|stamp_|_stamp$|(^|_)(header|frame_id)(_|$)/i;
const OWN = "amberbox";

/** Ask for all variables of a robot. @returns {Promise<Item[]>} */
export async function loadItems(robot) {
  const found = await ask(`/robots/${encodeURIComponent(robot)}/data/variables`);
  return found.map(itemOf);
}

function itemOf(about) {
  const { name, topic, type, rows, chosen } = about;
  const every = about.columns.map((column) => variableOf(about, column));
  const variables = [...every.filter((one) => !DULL.test(one.name)), ...every.filter((one) => DULL.test(one.name))];
  return { name, topic, type, rows, chosen, variables, rate: about.rate_hz, isOwn: about.source === OWN,
    first: maybeSeconds(about.first), last: maybeSeconds(about.last) };
}

function variableOf(item, column) {
  const { name, path, type, unit, labels } = column;
  const words = [item.name, item.topic, item.type, name, path, type, unit, ...Object.values(labels)];
  return { address: `${item.name}.${name}`, item: item.name, name, path, type, unit, labels,
    kind: UNDRAWN.test(type) ? null : kindOf(column), words: words.join(" ").toLowerCase() };
}

/**
 * Find a variable by its address: ITEM.COLUMN, ITEM.PATH, or the end of one path only. An ITEM alone
 * is the first of its variables that can be drawn: whoever says so means that it comes at all.
 * @param {Item[]} items @param {string} address @returns {?Variable}
 */
export function find(items, address) {
  const low = address.toLowerCase();
  const whole = items.find((item) => item.name.toLowerCase() === low);
  if (whole) return whole.variables.find((one) => one.kind && one.name !== "timestamp") ?? null;
  const fitting = items.filter((item) => low.startsWith(`${item.name.toLowerCase()}.`))
    .sort((one, other) => other.name.length - one.name.length);
  for (const item of fitting) {
    const found = within(item.variables, low.slice(item.name.length + 1));
    if (found) return found;
  }
  return null;
}

function within(variables, name) {
  const plain = (text) => text.toLowerCase().replaceAll(/[./]/g, "_");
  const exact = variables.find((one) => one.name.toLowerCase() === name) ?? variables.find((one) => plain(one.path) === plain(name));
  if (exact) return exact;
  const ends = variables.filter((one) => plain(one.path).endsWith(`_${plain(name)}`));
  return ends.length === 1 ? ends[0] : null;
}

/**
 * Find what fits all words: items with those of their variables that do.
 * @param {Item[]} items @param {string} text @returns {Item[]}
 */
export function search(items, text) {
  const words = text.toLowerCase().split(/\s+/).filter(Boolean);
  const fits = (one) => words.every((word) => one.words.includes(word));
  return items.map((item) => ({ ...item, variables: item.variables.filter(fits) }))
    .filter((item) => item.variables.length);
}

/** Tell whether a variable has numbers, also under names. @param {Variable} variable */
export const isNumber = ({ kind }) => Boolean(kind) && kind !== "text";

/** Suggest variables to begin with. @param {Item[]} items @returns {Variable[]} */
export function suggested(items, most = 6) {
  const drawn = items.filter((item) => !item.isOwn).flatMap((item) => item.variables)
    .filter((one) => one.kind && !DULL.test(one.name));
  const chosen = items.flatMap((item) => item.variables.filter((one) => item.chosen.includes(one.name) && one.kind));
  const telling = TELLING.flatMap((words) => drawn.filter((one) => words.test(one.address)).slice(0, 2));
  return [...new Set([...telling, ...chosen, ...drawn])].slice(0, most);
}

/** When the first and the last row of a robot came; null without any. @param {Item[]} items */
export function reach(items) {
  const pick = (name, best) => {
    const times = items.map((item) => item[name]).filter((time) => time !== null);
    return times.length ? best(...times) : null;
  };
  return { first: pick("first", Math.min), last: pick("last", Math.max) };
}
