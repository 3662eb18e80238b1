/**
 * What happened beside the values: marks (alarms, incidents, missions, notes, events), and lanes of
 * states.
 *
 * @typedef {object} Mark
 * @property {string} id @property {string} kind @property {number} from seconds
 * @property {?number} to seconds; null for a moment, and for what lasts
 * @property {string} text @property {string} href empty for none @property {string} level
 *
 * @typedef {{id: string, label: string, stretches: {from: number, to: number, level: string,
 *   text: string}[]}} Lane
 */

import { ask } from "./ask.js";
import { asked, maybeSeconds, seconds } from "./plotdata.js";
import { has, t } from "./strings.js";

const LIMIT = 200;
const LANE_POINTS = 400;
const LOADERS = { alarm: alarms, incident: incidents, mission: missions, event: events };

/** The kinds of marks that can be asked for. */
export const MARK_KINDS = Object.keys(LOADERS);

/**
 * Ask for the marks of a robot in a range; of what cannot be had there are none.
 * @param {string} robot @param {string[]} kinds @returns {Promise<Mark[]>}
 */
export async function loadMarks(robot, kinds, from, to, signal) {
  const found = await Promise.all(kinds.map((kind) => LOADERS[kind](robot, from, to, signal)));
  return found.flat().sort((one, other) => one.from - other.from);
}

/**
 * Ask for the states of components. @param {string} robot
 * @param {string[]} components all without a name @returns {Promise<Lane[]>}
 */
export async function loadLanes(robot, components, from, to, signal) {
  const one = components.length === 1 ? { component: components[0] } : {};
  const answer = await ask(pathOf(robot, "timeline", from, to, { points: LANE_POINTS, ...one }), { signal });
  return answer.lanes
    .filter((lane) => !lane.mode && (!components.length || components.includes(lane.component)))
    .map((lane) => ({ id: lane.component, label: lane.component, stretches: lane.stretches.map(stretch) }));
}

function stretch(one) {
  const words = [t(`common.level.${wordOf(one.level)}`), one.state, one.reason];
  const text = [...new Set(words.filter(Boolean))].join(", ");
  const more = one.changes > 1 ? ` (${t("plot.changes", { n: one.changes })})` : "";
  return { from: seconds(one.from), to: seconds(one.to), level: one.level, text: text + more };
}

/** The word of a level in the catalogue. */
function wordOf(level) {
  return has(`common.level.${level}`) ? level : "unknown";
}

function pathOf(robot, what, from, to, more = {}) {
  const query = new URLSearchParams({ from: asked(Math.max(from, 0)), to: asked(to), ...more });
  return `/api/v1/robots/${encodeURIComponent(robot)}/${what}?${query}`;
}

async function alarms(robot, from, to, signal) {
  const query = new URLSearchParams({ robot, since: asked(Math.max(from, 0)), limit: LIMIT });
  const found = await ask(`/api/v1/alarms?${query}`, { signal });
  return found
    .map((alarm) => ({
      id: `alarm-${alarm.id}`, kind: "alarm", from: seconds(alarm.opened), to: maybeSeconds(alarm.cleared),
      text: alarm.reason, href: `/alarms/${alarm.id}`, level: alarm.level,
    }))
    .filter((mark) => mark.from < to && (mark.to === null || mark.to >= from));
}

async function incidents(robot, from, to, signal) {
  const found = await ask(pathOf(robot, "incidents", from, to, { limit: LIMIT }), { signal });
  return found.map((one) => ({
    id: `incident-${one.id}`, kind: "incident", from: seconds(one.from), to: seconds(one.to),
    text: one.reason || one.id, href: "", level: "",
  }));
}

async function missions(robot, from, to, signal) {
  const found = await ask(pathOf(robot, "missions", from, to, { limit: LIMIT }), { signal });
  return found.flatMap((one) => [missionOf(one), ...one.notes.map((note, n) => noteOf(one, note, n))]);
}

function missionOf(one) {
  const text = one.outcome ? t("plot.mission_ended", { name: one.name, outcome: one.outcome }) : one.name;
  return { id: `mission-${one.id}`, kind: "mission", from: seconds(one.from), to: maybeSeconds(one.to), text,
    href: "", level: one.failed ? "error" : "" };
}

function noteOf(mission, note, n) {
  return { id: `note-${mission.id}-${n}`, kind: "note", from: seconds(note.at), to: null,
    text: `${note.text} (${note.who})`, href: "", level: "" };
}

async function events(robot, from, to, signal) {
  const found = await ask(pathOf(robot, "events", from, to, { limit: LIMIT }), { signal });
  return found.filter((one) => one.at || one.server_at).map((one) => ({
    id: `event-${one.store_id}-${one.writer}-${one.run}-${one.seq}`, kind: "event",
    from: seconds(one.server_at ?? one.at), to: null, text: one.text || one.kind, href: "", level: "",
  }));
}
