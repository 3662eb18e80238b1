// What people start from the data page: downloads, fetches, marks, notes, comparisons, jumps in time.

import { requestJson, robotApi, showError, toast } from "./api.js";
import { el, find, icon, setText, setTextAttribute } from "./dom.js";
import { dialogForm } from "./forms.js";
import { dateTime } from "./plot/axes.js";
import { t } from "./strings.js";
import { localTime, nowMs, secondsToStamp, stampToSeconds, timeElement } from "./time.js";

const RETRY_MS = 5000;
const DOWNLOAD_OVER = ["done", "failed", "cancelled", "expired"];
const FETCH_OVER = ["ready", "gone", "cancelled"];

/**
 * Show the jobs of the viewer in a list, until they are taken away: downloads that the server makes,
 * fetches of windows from a robot. @param {HTMLElement} list @param {string} robot
 * @param {{fetched: function(): void}} handlers `fetched`: a window has come from the robot
 */
export function jobList(list, robot, { fetched }) {
  const jobs = new Map();

  function follow(path, state, describe, over, ended) {
    const job = jobs.get(state.id) ?? { ...jobElement(state.id, cancel), path, describe, over, ended };
    if (!jobs.has(state.id)) list.append(job.root);
    jobs.set(state.id, job);
    list.hidden = false;
    show(job, state);
  }

  /** Change only what differs: the button keeps the focus, and no text is read aloud twice. */
  function show(job, state) {
    job.state = state.state;
    const { text, progress = null, link = null } = job.describe(state);
    setText(job.text, text);
    job.bar.hidden = progress === null;
    job.bar.value = progress ?? 0;
    setTextAttribute(job.bar, "aria-label", text);
    if (!isOver(job)) return;
    job.picture.replaceChildren(icon("check"));
    if (link && !job.text.nextElementSibling.matches("a")) job.text.after(link);
    setText(job.button, t("data.works.close"));
    job.ended?.(state);
  }

  const isOver = (job) => job.over.includes(job.state);

  async function update(id) {
    const job = jobs.get(id);
    if (!job || isOver(job)) return;
    const state = await requestJson(job.path).catch(() => null);
    if (!state) setTimeout(update, RETRY_MS, id);
    else if (jobs.has(id)) show(job, state);
  }

  async function cancel(id) {
    const job = jobs.get(id);
    try {
      if (!isOver(job)) await requestJson(job.path, { method: "DELETE" });
    } catch (error) {
      showError(error, job.root);
      return;
    }
    job.root.remove();
    jobs.delete(id);
    list.hidden = jobs.size === 0;
  }

  return {
    /** Follow a download. @param {any} state from the server */
    download: (state) => follow(`/api/v1/downloads/${state.id}`, state, downloadStatus, DOWNLOAD_OVER),
    /** Follow a fetch. @param {any} state from the server */
    fetch: (state) => follow(`${robotApi(robot)}/fetches/${state.id}`, state, fetchStatus, FETCH_OVER,
      ({ state }) => state === "ready" && fetched()),
    update,
    updateAll: () => [...jobs.keys()].forEach(update),
    isFetching: () => [...jobs.values()].some((job) => job.over === FETCH_OVER && !isOver(job)),
  };
}

/** Make the elements of a job. @param {string} id @param {function(string): void} cancel */
function jobElement(id, cancel) {
  const picture = el("span", {}, icon("time"));
  const text = el("span", { class: "work-text", role: "status" });
  const bar = el("progress", { max: 1 });
  const button = el("button", { class: "button quiet small", type: "button", onclick: () => cancel(id) }, t("data.works.stop"));
  return { root: el("li", { class: "work", "data-work": id }, picture, text, bar, button), picture, text, bar, button };
}

/** Describe a download: its `progress` from 0 to 1 while it is being made, then the `link` to its file. */
function downloadStatus(state) {
  const name = state.missions.length ? t("data.works.missions", { n: state.missions.length }) : t("data.works.view");
  const text = t(`data.works.download.${state.state}`, { name: `${name} (${state.format})` });
  if (state.state === "done") {
    return { text, link: el("a", { href: `/api/v1/downloads/${state.id}/file`, download: state.file ?? "" }, state.file ?? t("data.works.file")) };
  }
  if (state.state === "failed") return { text: `${text} ${state.error}` };
  return { text, progress: DOWNLOAD_OVER.includes(state.state) ? null : state.progress };
}

function fetchStatus(state) {
  return { text: t(`data.works.fetch.${state.state}`, { copied: state.copied, n: state.journals.length }) + (state.reason ? ` ${state.reason}` : "") };
}

const MOST_MOMENTS = 12;
const BEFORE_ALARM_S = 60;
const AFTER_ALARM_S = 60;
const MARGIN_PART = 0.05;

/**
 * Start the menu of moments to go to, loaded when it opens: missions, incidents and alarms.
 * @param {HTMLDetailsElement} menu
 * @param {string} robot @param {function(number, number, ?string): void} go window, id of a mission
 */
export function startMomentMenu(menu, robot, go) {
  const list = menu.querySelector(".menu-list");
  menu.addEventListener("toggle", () => {
    if (menu.open) loadMoments(list, robot, (...where) => {
      menu.open = false;
      go(...where);
    });
  });
}

async function loadMoments(list, robot, go) {
  const path = robotApi(robot);
  try {
    const [missions, incidents, alarms] = await Promise.all([
      requestJson(`${path}/missions?limit=${MOST_MOMENTS}`), requestJson(`${path}/incidents?limit=${MOST_MOMENTS}`),
      requestJson(`/api/v1/alarms?${new URLSearchParams({ robot, limit: MOST_MOMENTS })}`)]);
    list.replaceChildren(
      ...menuPart(t("data.goto.missions"), missions, (item) => [item.name, item.from, () => go(...withMargin(windowOf(item)), item.id)]),
      ...menuPart(t("data.goto.incidents"), incidents, (item) => [item.reason || item.id, item.from, () => go(...withMargin(windowOf(item)), null)]),
      ...menuPart(t("data.goto.alarms"), alarms, (item) => [item.reason, item.opened, () => go(...windowOfAlarm(item), null)]));
    if (!list.children.length) list.append(el("p", { class: "muted" }, t("data.goto.none")));
  } catch (error) {
    showError(error, list);
  }
}

function menuPart(title, items, describe) {
  if (!items.length) return [];
  const buttons = items.map((item) => {
    const [text, at, onClick] = describe(item);
    return el("button", { type: "button", onclick: onClick }, el("span", { class: "goto-text" }, text), " ", el("span", { class: "muted small" }, timeElement(at)));
  });
  return [el("p", { class: "menu-title small muted" }, title), ...buttons];
}

/** Return the window of a mission or an incident, up to now if it still lasts. */
export const windowOf = (item) => [stampToSeconds(item.from), stampToSeconds(item.to) ?? nowMs() / 1000];

/** Return a window with a margin at both ends. */
export function withMargin([from, to]) {
  const margin = Math.max((to - from) * MARGIN_PART, 1);
  return [from - margin, to + margin];
}

function windowOfAlarm(alarm) {
  const from = stampToSeconds(alarm.opened);
  const to = Math.min(stampToSeconds(alarm.cleared) ?? from, from + 10 * AFTER_ALARM_S);
  return [from - BEFORE_ALARM_S, to + AFTER_ALARM_S];
}

/**
 * Start the dialogs that mark the window as an incident, and a moment with a note.
 * @param {string} robot
 * @param {{window: function(): {from: number, to: number}, cursor: function(): ?number,
 *   changed: function(): void}} page
 */
export function startMarkDialogs(robot, { window, cursor, changed }) {
  const path = robotApi(robot);
  const note = { at: 0 };

  dialogForm("mark", {
    opened(form) {
      const { from, to } = window();
      setText(find("[data-span]", form), t("data.span", { from: dateTime(from, 1), to: dateTime(to, 1) }));
    },
    async send({ reason }) {
      const { from, to } = window();
      await requestJson(`${path}/incidents`, { method: "POST", body: { reason, from: secondsToStamp(from), to: secondsToStamp(to) } });
      toast(t("data.mark.done"));
      changed();
    },
  });

  dialogForm("note", {
    async opened(form) {
      const { from, to } = window();
      note.at = cursor() ?? (from + to) / 2;
      setText(find("[data-at]", form), dateTime(note.at, 0.1));
      await offerMissionsAt(form, path, note.at);
    },
    async send({ text, mission }) {
      const place = mission ? `${path}/missions/${encodeURIComponent(mission)}` : path;
      await requestJson(`${place}/notes`, { method: "POST", body: { text, at: secondsToStamp(note.at) } });
      toast(t("data.note.done"));
      changed();
    },
  });
}

/** Offer the missions that were running at a moment. */
async function offerMissionsAt(form, path, at) {
  const submit = find('button[type="submit"]', form);
  submit.disabled = true;
  const query = new URLSearchParams({ from: secondsToStamp(at - 1), to: secondsToStamp(at + 1) });
  const found = await requestJson(`${path}/missions?${query}`).catch(() => []);
  const running = found.filter((mission) => {
    const [from, to] = windowOf(mission);
    return from <= at && at <= to;
  });
  const named = running.map((mission) => el("option", { value: mission.id }, `${mission.name} · ${mission.id}`));
  form.elements.mission.replaceChildren(...named, el("option", { value: "" }, t("data.note.no_mission")));
  find("[data-some]", form).hidden = !running.length;
  submit.disabled = false;
}

const MOST_MISSIONS = 50;
const MOST_ROWS = 5_000_000;

/**
 * Start the dialog that downloads the shown data or whole missions. @param {string} robot
 * @param {{window: function(): {from: number, to: number},
 *   chosen: function(): import("./data_variables.js").Variable[], started: function(any): void}} page
 */
export function startDownloadDialog(robot, { window, chosen, started }) {
  dialogForm("download", {
    opened(form) {
      const { from, to } = window();
      const names = chosen().map((variable) => variable.address);
      setText(find("[data-span]", form), t("data.span", { from: dateTime(from, 1), to: dateTime(to, 1) }));
      setText(find("[data-names]", form), names.length ? names.join(", ") : t("data.download.everything"));
      showDirectLinks(find("[data-direct]", form), robot, chosen(), { from, to });
      showParts(form);
      form.onchange = () => showParts(form);
      offerMissions(form, robot);
    },
    async send(fields) {
      const body = fields.what === "view" ? viewRequest(fields, chosen(), window()) : { missions: fields.missions };
      started(await requestJson("/api/v1/downloads", { method: "POST", body: { robots: [robot], format: fields.format, ...body } }));
    },
  });
}

/** Return the request for what is shown: the window, and the variables of each item. */
function viewRequest({ format }, variables, { from, to }) {
  const groups = Map.groupBy(variables, (variable) => variable.item);
  const columns = Object.fromEntries([...groups].map(([item, group]) => [item, group.map((variable) => variable.name)]));
  return { items: [...groups.keys()], variables: format === "mcap" ? {} : columns, from: secondsToStamp(from), to: secondsToStamp(to) };
}

/** Show links to files of the shown data, one for each item. */
function showDirectLinks(place, robot, variables, { from, to }) {
  const links = [...Map.groupBy(variables, (variable) => variable.item)].map(([item, group]) => {
    const query = new URLSearchParams({ item, from: secondsToStamp(from), to: secondsToStamp(to), format: "csv", limit: MOST_ROWS });
    for (const variable of group) query.append("variables", variable.name);
    return el("a", { href: `${robotApi(robot)}/query?${query}`, download: true }, t("data.download.at_once", { item }));
  });
  place.replaceChildren(...links.map((link) => el("li", {}, link)));
  place.parentElement.hidden = !links.length;
}

function showParts(form) {
  const isView = form.elements.what.value === "view";
  for (const part of form.querySelectorAll("[data-for]")) part.hidden = (part.dataset.for === "view") !== isView;
}

async function offerMissions(form, robot) {
  const found = await requestJson(`${robotApi(robot)}/missions?limit=${MOST_MISSIONS}`).catch(() => []);
  const lines = found.map((mission) => el("label", { class: "field check" },
    el("input", { type: "checkbox", name: "missions", value: mission.id, "data-type": "list" }),
    el("span", {}, mission.name, " ", el("span", { class: "muted small" }, localTime(Date.parse(mission.from)), mission.outcome ? ` · ${mission.outcome}` : ""))));
  find("[data-missions]", form).replaceChildren(...(lines.length ? lines : [el("p", { class: "muted" }, t("data.goto.none"))]));
}

const MOST_COMPARED = 50;

/**
 * Start the dialog that compares two missions, and the button that ends it. @param {string} robot
 * @param {{begin: function(string[]): void, end: function(): void}} actions
 */
export function startCompareDialog(robot, { begin, end }) {
  dialogForm("compare", {
    async opened(form) {
      const missions = await requestJson(`${robotApi(robot)}/missions?limit=${MOST_COMPARED}`).catch(() => []);
      ["first", "second"].forEach((name, n) => form.elements[name].replaceChildren(...missions.map((mission, k) =>
        el("option", { value: mission.id, selected: k === n }, `${mission.name} · ${localTime(Date.parse(mission.from))}`))));
      find("[data-none]", form).hidden = missions.length > 1;
      find('button[type="submit"]', form).disabled = missions.length < 2;
    },
    async send({ first, second }) {
      begin([first, second]);
    },
  });
  find("#end-compare").addEventListener("click", end);
}
