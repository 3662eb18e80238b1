// The recordings of one robot: parts that follow the server, chosen missions, checks of files.

import { requestJson, robotApi, showError } from "./api.js";
import { el, find, findAll, icon, setText } from "./dom.js";
import { subscribe } from "./feed.js";
import { fetchFragment, replaceElement } from "./fragments.js";
import { followStates } from "./recording_states.js";
import { t } from "./strings.js";
import { msToField, nowMs } from "./time.js";

const BATCH = 20;
const READABLE = ["intact", "unsigned", "altered"];

/**
 * Check all files of a robot in batches, with a progress bar and a button that stops it. Returns the
 * names of altered files.
 * @param {string} robot
 * @param {number} total
 * @param {HTMLElement} place of the progress bar
 * @returns {Promise<string[]>}
 */
async function checkFiles(robot, total, place) {
  const stop = new AbortController();
  const totals = { looked: 0, read: 0, missing: 0, altered: [], isStopped: false };
  const show = showProgress(place, total, () => stop.abort());
  try {
    for await (const batch of fileBatches(robot, stop.signal)) {
      countBatch(totals, batch);
      show(totals.looked);
    }
  } catch (error) {
    if (error.name !== "AbortError") throw error;
    totals.isStopped = true;
  }
  place.replaceChildren(...resultOf(totals, total));
  return totals.altered;
}

async function* fileBatches(robot, signal) {
  let after = "";
  for (;;) {
    const query = new URLSearchParams({ check: "true", limit: String(BATCH), after });
    const batch = await requestJson(`${robotApi(robot)}/recordings?${query}`, { signal });
    yield batch;
    if (batch.length < BATCH) return;
    after = fileName(batch.at(-1));
  }
}

const fileName = (file) => `${file.store_id}/${file.journal}`;

function countBatch(totals, batch) {
  totals.looked += batch.length;
  totals.read += batch.filter((one) => READABLE.includes(one.integrity)).length;
  totals.missing += batch.filter((one) => one.integrity === "missing").length;
  totals.altered.push(...batch.filter((one) => one.integrity === "altered").map(fileName));
}

function showProgress(place, total, stop) {
  const bar = el("progress", { max: Math.max(total, 1), value: 0, "aria-label": t("recordings.check.at", { n: 0, all: total }) });
  const words = el("span", { class: "small muted", role: "status" });
  const button = el("button", { class: "button small", type: "button", onclick: stop }, t("recordings.check.stop"));
  place.replaceChildren(bar, el("div", { class: "spread" }, words, button));
  place.hidden = false;
  return (n) => {
    bar.value = n;
    setText(words, t("recordings.check.at", { n, all: total }));
  };
}

function resultOf({ looked, read, missing, altered, isStopped }, total) {
  const bad = altered.length;
  const text = t(bad ? "recordings.check.bad" : "recordings.check.good", { n: read, bad });
  const gone = missing ? ` ${t("recordings.check.gone", { n: missing })}` : "";
  const stopped = isStopped ? ` ${t("recordings.check.stopped", { n: looked, all: total })}` : "";
  const list = el("ul", { class: "mono small" }, ...altered.map((name) => el("li", {}, name)));
  const kind = bad || missing ? "problem" : "notice";
  const head = el("div", { class: kind, role: "status" }, icon(bad || missing ? "error" : "check"), " ", text + gone + stopped);
  return bad ? [head, list] : [head];
}

const PARTS = ["missions", "incidents", "fetches", "journals"];
const WINDOW_MS = 600_000;
const POSTPONED_MS = 5000;
const page = find("#recordings");
const { robot } = page.dataset;
const base = `/pieces/recordings/${encodeURIComponent(robot)}`;
const chosen = new Set();
const altered = new Set();
const postponed = new Set();

const partPath = (name) => `${base}/${name}?${new URLSearchParams(location.search)}`;
const partOf = (element) => element.closest("[data-part]");

/** Reload a part; later, if somebody is writing in it. */
async function reloadPart(name) {
  const old = find(`[data-part="${name}"]`);
  postponed.delete(name);
  if (hasInput(old)) {
    postponed.add(name);
    return;
  }
  const fresh = await fetchFragment(partPath(name)).catch((error) => error);
  if (fresh instanceof Error) return onUnreachable(old, fresh);
  if (!old.isConnected || hasInput(old)) return;
  replaceElement(old, fresh);
  showChosen();
}

/** Show the error in a part that was not loaded yet; any part is reloaded later. */
function onUnreachable(part, error) {
  postponed.add(part.dataset.part);
  if (part.getAttribute("aria-busy") === "true") showError(error, part);
}

function hasInput(part) {
  const fields = findAll("form[data-post] :is(input, textarea)", part);
  return fields.some((field) => field.value !== field.defaultValue);
}

async function reloadCard() {
  const query = new URLSearchParams({ window: page.dataset.window, link: "false" });
  const fresh = await fetchFragment(`${base}?${query}`).catch(() => null); // the next change reloads it
  const old = find("[data-more]");
  if (!fresh || !old) return;
  replaceElement(old, fresh);
}

/** Show chosen missions and altered files, on parts that may be new. */
function showChosen() {
  for (const box of findAll('input[form="chosen"]')) box.checked = chosen.has(box.value);
  for (const button of findAll("[data-needs]")) {
    const needs = Number(button.dataset.needs);
    button.disabled = "compare" in button.dataset ? chosen.size !== needs : chosen.size < needs;
  }
  setText(find("[data-number]"), t("recordings.chosen", { n: chosen.size }));
  for (const row of findAll("tr[data-file]")) if (altered.has(row.dataset.file)) markAltered(row);
}

function markAltered(row) {
  row.classList.add("is-altered");
  const level = find("[data-integrity] .level", row);
  level.className = "level level-error";
  setText(find(".word", level), t("recordings.check.altered"));
}

function compare(button) {
  const names = [...chosen].map(encodeURIComponent).join(",");
  location.assign(`${button.dataset.compare}?compare=${names}`);
}

async function runCheck(button) {
  button.disabled = true;
  const place = find("#check");
  try {
    for (const name of await checkFiles(robot, Number(button.dataset.check), place)) altered.add(name);
  } catch (error) {
    place.replaceChildren();
    showError(error, place);
  }
  for (const other of findAll("[data-check]")) other.disabled = false;
  showChosen();
}

/** Fill an opened form with the last ten minutes, in the viewer's zone. */
function prefillTimes(details) {
  const ends = { from: nowMs() - WINDOW_MS, to: nowMs() };
  for (const [name, ms] of Object.entries(ends)) {
    const field = find(`input[type="datetime-local"][name="${name}"]`, details);
    if (field && !field.value) field.value = field.defaultValue = msToField(ms);
  }
}

async function offerItems(list) {
  if (!list || list.childElementCount) return;
  const items = await requestJson(`${robotApi(robot)}/items`).catch(() => []); // a name can be typed
  list.append(...items.filter((item) => item.source !== "amberbox").map((item) => el("option", { value: item.name })));
}

/** Load the parts that take workers of the server, one after the other; then scroll to the fragment. */
async function start() {
  showChosen();
  for (const name of ["missions", "incidents"]) await reloadPart(name);
  await reloadCard();
  if (location.hash) document.getElementById(decodeURIComponent(location.hash.slice(1)))?.scrollIntoView();
}

page.addEventListener("change", ({ target }) => {
  if (!target.matches('input[form="chosen"]')) return;
  if (target.checked) chosen.add(target.value);
  else chosen.delete(target.value);
  showChosen();
});
page.addEventListener("click", ({ target }) => {
  const comparing = target.closest("[data-compare]");
  const checking = target.closest("[data-check]");
  if (comparing) compare(comparing);
  if (checking) runCheck(checking);
});
page.addEventListener("toggle", ({ target }) => {
  if (!target.open) return;
  prefillTimes(target);
  if (target.id === "new-fetch") offerItems(find("datalist", target));
}, true);
page.addEventListener("done", ({ target }) => {
  const part = partOf(target);
  if (!part) return;
  if (target.tagName === "FORM") {
    target.reset();
    const details = target.closest("details.recordings-forms");
    if (details) details.open = false;
  }
  reloadPart(part.dataset.part);
  updateStates();
});

const { update: updateStates } = followStates(() => [robot], (_, isAll) => {
  for (const name of isAll ? PARTS : ["journals"]) reloadPart(name);
  if (isAll) reloadCard();
});
subscribe({ robots: [robot], kinds: ["fetch"] }).on("fetch", () => reloadPart("fetches"));
setInterval(() => postponed.forEach(reloadPart), POSTPONED_MS);
start();
