/** The menu that leads to moments: missions, incidents and alarms of a robot, loaded when opened. */

import { ask, fail } from "../ask.js";
import { el } from "../dom.js";
import { maybeSeconds, seconds } from "../plot/data.js";
import { t } from "../strings.js";
import { nowMs, when } from "../time.js";

const MOST = 12;
const BEFORE_S = 60;
const AFTER_S = 60;
const PART = 0.05;

/**
 * Fill a menu as it opens. @param {HTMLDetailsElement} menu
 * @param {string} robot @param {function(number, number, ?string): void} go window, id of a mission
 */
export function goTo(menu, robot, go) {
  const list = menu.querySelector(".menu-list");
  menu.addEventListener("toggle", () => {
    if (menu.open) load(list, robot, (...where) => {
      menu.open = false;
      go(...where);
    });
  });
}

async function load(list, robot, go) {
  const path = `/api/v1/robots/${encodeURIComponent(robot)}`;
  try {
    const [missions, incidents, alarms] = await Promise.all([
      ask(`${path}/missions?limit=${MOST}`), ask(`${path}/incidents?limit=${MOST}`),
      ask(`/api/v1/alarms?${new URLSearchParams({ robot, limit: MOST })}`)]);
    list.replaceChildren(
      ...part(t("data.goto.missions"), missions, (one) => [one.name, one.from, () => go(...around(spanOf(one)), one.id)]),
      ...part(t("data.goto.incidents"), incidents, (one) => [one.reason || one.id, one.from, () => go(...around(spanOf(one)), null)]),
      ...part(t("data.goto.alarms"), alarms, (one) => [one.reason, one.opened, () => go(...aroundAlarm(one), null)]));
    if (!list.children.length) list.append(el("p", { class: "muted" }, t("data.goto.none")));
  } catch (error) {
    fail(error, list);
  }
}

function part(title, found, about) {
  if (!found.length) return [];
  const buttons = found.map((one) => {
    const [text, at, chosen] = about(one);
    return el("button", { type: "button", onclick: chosen }, el("span", { class: "goto-text" }, text), " ", el("span", { class: "muted small" }, when(at)));
  });
  return [el("p", { class: "menu-title small muted" }, title), ...buttons];
}

/** The window of a mission or an incident; what lasts ends now. */
export const spanOf = (one) => [seconds(one.from), maybeSeconds(one.to) ?? nowMs() / 1000];

/** A window with a little more at its ends. */
export function around([from, to]) {
  const more = Math.max((to - from) * PART, 1);
  return [from - more, to + more];
}

function aroundAlarm(alarm) {
  const from = seconds(alarm.opened);
  const to = Math.min(maybeSeconds(alarm.cleared) ?? from, from + 10 * AFTER_S);
  return [from - BEFORE_S, to + AFTER_S];
}
