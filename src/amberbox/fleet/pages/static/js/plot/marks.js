/**
 * What happened beside the values: marks (alarms, incidents, missions, notes), and lanes of states.
 *
 * @typedef {object} Mark
 * @property {string} id @property {string} kind @property {number} from seconds
 * @property {?number} to seconds; null for a moment, and for what lasts
 * @property {string} text @property {string} href empty for none @property {string} level
 *
 * @typedef {{id: string, label: string, stretches: {from: number, to: number, level: string,
 *   text: string}[]}} Lane
 */

import { maybeSeconds, seconds } from "./data.js";
import { has, t } from "../strings.js";

/**
 * The marks of a window; of what was not told there are none.
 * @param {{alarms?: any[], incidents?: any[], missions?: any[], notes?: any[]}} around @returns {Mark[]}
 */
export function marksOf({ alarms = [], incidents = [], missions = [], notes = [] }, { from, to }) {
  const lines = alarms.map(alarmOf).filter((mark) => mark.from < to && (mark.to === null || mark.to >= from));
  const ofMissions = missions.flatMap((one) => [missionOf(one), ...one.notes.map((note, n) => noteOf(`${one.id}-${n}`, note))]);
  const others = [...incidents.map(incidentOf), ...ofMissions, ...notes.map((note) => noteOf(note.id, note))];
  return [...lines, ...others].sort((one, other) => one.from - other.from);
}

/**
 * The states of components. @param {{timeline?: {lanes: any[]}}} around @returns {Lane[]}
 */
export function lanesOf({ timeline = { lanes: [] } }) {
  return timeline.lanes.filter((lane) => !lane.mode)
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

function alarmOf(alarm) {
  return { id: `alarm-${alarm.id}`, kind: "alarm", from: seconds(alarm.opened), to: maybeSeconds(alarm.cleared),
    text: alarm.reason, href: `/alarms/${alarm.id}`, level: alarm.level };
}

function incidentOf(one) {
  return { id: `incident-${one.id}`, kind: "incident", from: seconds(one.from), to: seconds(one.to),
    text: one.reason || one.id, href: "", level: "" };
}

function missionOf(one) {
  const text = one.outcome ? t("plot.mission_ended", { name: one.name, outcome: one.outcome }) : one.name;
  return { id: `mission-${one.id}`, kind: "mission", from: seconds(one.from), to: maybeSeconds(one.to), text,
    href: "", level: one.failed ? "error" : "" };
}

function noteOf(id, note) {
  return { id: `note-${id}`, kind: "note", from: seconds(note.at), to: null,
    text: `${note.text} (${note.who})`, href: "", level: "" };
}
