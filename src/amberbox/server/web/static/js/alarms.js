// The list of alarms: filters, selection, keys, and acknowledging several at once.

import { clearError, latestSignal, requestJson, showError, toast } from "./api.js";
import { find, findAll, setText } from "./dom.js";
import { subscribe } from "./feed.js";
import { fetchFragment, replaceElement, throttledFragment } from "./fragments.js";
import { t } from "./strings.js";
import { debounce, fieldToStamp, msToField } from "./time.js";
import { getParam, onNavigation, setParams } from "./url.js";

const SEARCH_PAUSE_MS = 250;
const DEFAULTS = { severity: "warning", sort: "worst" };
const EDITABLE = "input:not([type=checkbox]), select, textarea, [contenteditable], dialog";

const alarmList = () => find("#alarms");
const alarmRows = () => findAll("#alarms .alarm");
const checkboxes = () => findAll("#alarms [data-choose]");

/**
 * Keep the selection of alarms while the list changes; the bar is shown while there is one.
 * @param {HTMLFormElement} bar
 */
function selection(bar) {
  const ids = new Set();

  /** Show the selection, without alarms that are no longer in the list. */
  function show() {
    const listed = new Set(checkboxes().map((box) => box.value));
    for (const id of ids) if (!listed.has(id)) ids.delete(id);
    for (const box of checkboxes()) box.checked = ids.has(box.value);
    const allBox = find("[data-choose-all]");
    if (allBox) allBox.checked = ids.size > 0 && ids.size === listed.size;
    if (allBox) allBox.indeterminate = ids.size > 0 && ids.size < listed.size;
    bar.hidden = ids.size === 0;
    setText(find("[data-chosen]", bar), t("alarms.chosen", { n: ids.size }));
  }

  function choose(items, isChosen) {
    for (const id of items) {
      if (isChosen) ids.add(id);
      else ids.delete(id);
    }
    show();
  }

  document.addEventListener("change", ({ target }) => {
    if (target.matches("[data-choose]")) choose([target.value], target.checked);
    if (target.matches("[data-choose-all]")) choose(checkboxes().map((box) => box.value), target.checked);
  });
  find("[data-let-go]", bar).addEventListener("click", () => choose([...ids], false));

  return {
    show,
    drop: (items) => choose(items, false),
    toggle: (row) => find("[data-choose]", row) && choose([row.dataset.alarm], !ids.has(row.dataset.alarm)),
    rows: () => alarmRows().filter((row) => ids.has(row.dataset.alarm)),
  };
}

// the alarm that had the focus last
const current = { id: null, place: 0 };

const focusedRow = () => document.activeElement?.closest("#alarms .alarm") ?? null;

/** Note the alarm that the viewer focused; not called when the focus is lost with a replaced list. */
function noteCurrent() {
  const row = focusedRow();
  if (row) Object.assign(current, { id: row.dataset.alarm, place: alarmRows().indexOf(row) });
  else if (document.activeElement !== document.body) current.id = null;
}

function moveBy(step) {
  const list = alarmRows();
  if (list.length === 0) return;
  const at = list.indexOf(focusedRow() ?? find(`#alarms .alarm[data-alarm="${current.id}"]`));
  const next = at < 0 ? (step > 0 ? 0 : list.length - 1) : Math.min(Math.max(at + step, 0), list.length - 1);
  list[next].focus();
  noteCurrent();
}

/** Focus the current alarm in a new list, or the next one if it is gone. */
function restoreFocus() {
  const isMine = document.activeElement === document.body || focusedRow() !== null;
  if (current.id === null || !isMine) return;
  const list = alarmRows();
  const row = list.find((other) => other.dataset.alarm === current.id) ?? list[Math.min(current.place, list.length - 1)];
  if (row && !row.contains(document.activeElement)) row.focus({ preventScroll: true });
  noteCurrent();
}

/**
 * Listen to keys that go through the list and act on its rows, while nobody writes.
 * @param {{acknowledge: (row: HTMLElement) => void, choose: (row: HTMLElement) => void}} actions
 */
function startKeys({ acknowledge, choose }) {
  const moves = { j: 1, k: -1, ArrowDown: 1, ArrowUp: -1 };
  const actions = {
    o: (row) => find(".alarm-title a", row).click(),
    a: (row) => find("[data-acknowledge]", row) && acknowledge(row),
    x: choose,
  };

  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest(EDITABLE)) return;
    const row = focusedRow();
    if (event.key in moves && (event.key.length === 1 || row)) moveBy(moves[event.key]);
    else if (event.key in actions && row) actions[event.key](row);
    else if (event.key === "Enter" && event.target === row) actions.o(row);
    else return;
    event.preventDefault();
  });
  for (const kind of ["keyup", "pointerup"]) document.addEventListener(kind, noteCurrent);
}

const form = find("#look");
const bulk = find("#bulk");
const chosen = selection(bulk);
const searchSoon = debounce((input) => changeView({ q: input.value.trim() }, { push: false }), SEARCH_PAUSE_MS);
const nextSignal = latestSignal();

const listPath = () => `/pieces/alarms${location.search}`;
const refreshList = throttledFragment(alarmList, listPath, 1000, onListReplaced);

function onListReplaced() {
  chosen.show();
  restoreFocus();
}

async function changeView(changes, { push = true } = {}) {
  setParams({ n: null, ...changes }, { push });
  showFilters();
  clearError(form);
  try {
    replaceElement(alarmList(), await fetchFragment(listPath(), { signal: nextSignal() }));
    onListReplaced();
  } catch (error) {
    if (error.name !== "AbortError") showError(error, form);
  }
}

/** Show the filters of the address in the form. */
function showFilters() {
  form.elements.state.value = getParam("state", "open");
  for (const name of ["severity", "robot", "team", "sort"]) {
    if (form.elements[name]) form.elements[name].value = getParam(name, DEFAULTS[name] ?? "");
  }
  if (document.activeElement !== form.elements.q) form.elements.q.value = getParam("q");
  showPeriod();
}

function showPeriod() {
  const from = getParam("from");
  const { options } = form.elements.from;
  const isOffered = [...options].some((option) => option.value === from) && !getParam("to");
  if (isOffered && !(from === "" && form.elements.from.value === "own")) form.elements.from.value = from;
  else form.elements.from.value = "own";
  find("#own-period").hidden = form.elements.from.value !== "own";
  for (const input of findAll("[data-end]")) input.value = msToField(Date.parse(getParam(input.dataset.end))).slice(0, 16);
}

function choosePeriod(value) {
  find("#own-period").hidden = value !== "own";
  if (value !== "own") changeView({ from: value, to: null });
}

function onChange({ target }) {
  const { name, value, dataset } = target;
  if (dataset.end) changeView({ from: stampOfEnd("from"), to: stampOfEnd("to") });
  else if (name === "from") choosePeriod(value);
  else if (name in DEFAULTS) changeView({ [name]: value === DEFAULTS[name] ? null : value });
  else if (name === "robot" || name === "team") changeView({ [name]: value });
}

function stampOfEnd(end) {
  const { value } = find(`[data-end="${end}"]`);
  return fieldToStamp(value) || null;
}

/** Tabs and "more" change the list alone, unless they are opened in a new window. */
function onLink(event) {
  const link = event.target.closest("a[data-tab], a[data-more]");
  if (!link || event.ctrlKey || event.metaKey || event.shiftKey) return;
  event.preventDefault();
  if (link.dataset.more) changeView({ n: link.dataset.more }, { push: false });
  else changeView({ state: link.dataset.tab === "open" ? null : link.dataset.tab });
}

/** Acknowledge alarms as they are shown, and report how many were, and how many had changed. */
async function acknowledge(rows, note = "") {
  const requests = rows.map((row) => requestJson(`/api/v1/alarms/${row.dataset.alarm}/acknowledge`, {
    method: "POST", body: { revision: Number(row.dataset.revision), note },
  }));
  const answers = await Promise.allSettled(requests);
  const done = rows.filter((_, k) => answers[k].status === "fulfilled");
  chosen.drop(done.map((row) => row.dataset.alarm));
  reportResults(answers);
  refreshList();
}

function reportResults(answers) {
  const refused = answers.filter((one) => one.status === "rejected").map((one) => one.reason);
  const changed = refused.filter((error) => error.status === 409).length;
  const done = answers.length - refused.length;
  if (done) toast(countText("alarms.acknowledged", done));
  if (changed) toast(countText("alarms.not_acknowledged", changed), "error");
  for (const error of refused.filter((one) => one.status !== 409)) showError(error, null);
}

const countText = (name, n) => (n === 1 ? t(`${name}_one`) : t(name, { n }));

async function sendBulk(event) {
  event.preventDefault();
  const button = find("button.primary", bulk);
  button.setAttribute("aria-busy", "true");
  await acknowledge(chosen.rows(), bulk.elements.note.value);
  button.removeAttribute("aria-busy");
  bulk.elements.note.value = "";
}

form.addEventListener("submit", (event) => event.preventDefault());
form.addEventListener("input", ({ target }) => target.name === "q" && searchSoon(target));
form.addEventListener("change", onChange);
document.addEventListener("click", onLink);
document.addEventListener("click", (event) => {
  const button = event.target.closest("[data-acknowledge]");
  if (button) acknowledge([button.closest(".alarm")]);
});
bulk.addEventListener("submit", sendBulk);
onNavigation(() => changeView({}, { push: false }));
startKeys({ acknowledge: (row) => acknowledge([row]), choose: chosen.toggle });
showPeriod();

const feed = subscribe({ kinds: ["alarm"] });
for (const kind of ["alarm", "snapshot"]) feed.on(kind, refreshList);
