// The recordings of one robot: its parts follow what happens, missions are chosen, files checked.

import { ask, fail } from "../ask.js";
import { all, el, one, setText } from "../dom.js";
import { listen } from "../feed.js";
import { piece, put } from "../pieces.js";
import { check } from "./check.js";
import { followStates } from "./state.js";
import { t } from "../strings.js";
import { fieldText, nowMs } from "../time.js";

const PARTS = ["missions", "incidents", "fetches", "journals"];
const WINDOW_MS = 600_000;
const LATE_MS = 5000;
const page = one("#recordings");
const { robot } = page.dataset;
const base = `/pieces/recordings/${encodeURIComponent(robot)}`;
const chosen = new Set();
const altered = new Set();
const late = new Set();

const address = (name) => `${base}/${name}?${new URLSearchParams(location.search)}`;
const partOf = (element) => element.closest("[data-part]");

/** Ask for a part anew, unless somebody is writing in it: then later. */
async function reload(name) {
  const old = one(`[data-part="${name}"]`);
  late.delete(name);
  if (isBusy(old)) {
    late.add(name);
    return;
  }
  const fresh = await piece(address(name)).catch((error) => error);
  if (fresh instanceof Error) return unreachable(old, fresh);
  if (!old.isConnected || isBusy(old)) return;
  put(old, fresh);
  mark();
}

/** Say what is wrong where nothing is yet; what is there already stays, and is asked for again. */
function unreachable(part, error) {
  late.add(part.dataset.part);
  if (part.getAttribute("aria-busy") === "true") fail(error, part);
}

function isBusy(part) {
  const fields = all("form[data-post] :is(input, textarea)", part);
  return fields.some((field) => field.value !== field.defaultValue);
}

async function reloadCard() {
  const query = new URLSearchParams({ window: page.dataset.window, link: "false" });
  const fresh = await piece(`${base}?${query}`).catch(() => null); // as above
  const old = one("[data-more]");
  if (!fresh || !old) return;
  put(old, fresh);
}

/** Show what is chosen and what is altered, on parts that may be new. */
function mark() {
  for (const box of all('input[form="chosen"]')) box.checked = chosen.has(box.value);
  for (const button of all("[data-needs]")) {
    const needs = Number(button.dataset.needs);
    button.disabled = "compare" in button.dataset ? chosen.size !== needs : chosen.size < needs;
  }
  setText(one("[data-number]"), t("recordings.chosen", { n: chosen.size }));
  for (const row of all("tr[data-file]")) if (altered.has(row.dataset.file)) markAltered(row);
}

function markAltered(row) {
  row.classList.add("is-altered");
  const level = one("[data-integrity] .level", row);
  level.className = "level level-error";
  setText(one(".word", level), t("recordings.check.altered"));
}

function compare(button) {
  const names = [...chosen].map(encodeURIComponent).join(",");
  location.assign(`${button.dataset.compare}?compare=${names}`);
}

async function checkNow(button) {
  button.disabled = true;
  const place = one("#check");
  try {
    for (const name of await check(robot, Number(button.dataset.check), place)) altered.add(name);
  } catch (error) {
    place.replaceChildren();
    fail(error, place);
  }
  for (const known of all("[data-check]")) known.disabled = false;
  mark();
}

/** A form that is opened begins with the last ten minutes, in the viewer's zone. */
function prefill(details) {
  const ends = { from: nowMs() - WINDOW_MS, to: nowMs() };
  for (const [name, ms] of Object.entries(ends)) {
    const field = one(`input[type="datetime-local"][name="${name}"]`, details);
    if (field && !field.value) field.value = field.defaultValue = fieldText(ms);
  }
}

async function offerItems(list) {
  if (!list || list.childElementCount) return;
  const items = await ask(`/api/v1/robots/${encodeURIComponent(robot)}/items`).catch(() => []); // a name can be typed
  list.append(...items.filter((item) => item.source !== "amberbox").map((item) => el("option", { value: item.name })));
}

/** Ask for what workers have to be asked for, one after the other; then go where the address says. */
async function start() {
  mark();
  for (const name of ["missions", "incidents"]) await reload(name);
  await reloadCard();
  if (location.hash) document.getElementById(decodeURIComponent(location.hash.slice(1)))?.scrollIntoView();
}

page.addEventListener("change", ({ target }) => {
  if (!target.matches('input[form="chosen"]')) return;
  if (target.checked) chosen.add(target.value);
  else chosen.delete(target.value);
  mark();
});
page.addEventListener("click", ({ target }) => {
  const comparing = target.closest("[data-compare]");
  const checking = target.closest("[data-check]");
  if (comparing) compare(comparing);
  if (checking) checkNow(checking);
});
page.addEventListener("toggle", ({ target }) => {
  if (!target.open) return;
  prefill(target);
  if (target.id === "new-fetch") offerItems(one("datalist", target));
}, true);
page.addEventListener("done", ({ target }) => {
  const part = partOf(target);
  if (!part) return;
  if (target.tagName === "FORM") {
    target.reset();
    const details = target.closest("details.recordings-forms");
    if (details) details.open = false;
  }
  reload(part.dataset.part);
  look();
});

const { look } = followStates(() => [robot], (_, isAll) => {
  for (const name of isAll ? PARTS : ["journals"]) reload(name);
  if (isAll) reloadCard();
});
listen({ robots: [robot], kinds: ["fetch"] }).on("fetch", () => reload("fetches"));
setInterval(() => late.forEach(reload), LATE_MS);
start();
