// The list of alarms: it follows what one looks for and what happens; keys and bulk acknowledging.

import { ask, clear, fail, toast } from "../ask.js";
import * as keys from "./keys.js";
import { chosen } from "./chosen.js";
import { all, one } from "../dom.js";
import { listen } from "../feed.js";
import { keep, piece, put } from "../pieces.js";
import { t } from "../strings.js";
import { fieldStamp, fieldText } from "../time.js";
import * as view from "../view.js";

const TYPING_MS = 250;
const USUAL = { severity: "warning", sort: "worst" };
const form = one("#look");
const bulk = one("#bulk");
const choice = chosen(bulk);
let typing = null;
let looking = new AbortController();

const find = () => one("#alarms");
const address = () => `/pieces/alarms${location.search}`;
const stale = keep(find, address, 1000, placed);

/** Show the list anew, with what was chosen and where one was. */
function placed() {
  choice.show();
  keys.stay();
}

async function look(changes, { push = true } = {}) {
  view.set({ n: null, ...changes }, { push });
  mark();
  clear(form);
  looking.abort();
  looking = new AbortController();
  try {
    put(find(), await piece(address(), { signal: looking.signal }));
    placed();
  } catch (error) {
    if (error.name !== "AbortError") fail(error, form);
  }
}

/** Show in the form what the address says. */
function mark() {
  form.elements.state.value = view.get("state", "open");
  for (const name of ["severity", "robot", "team", "sort"]) {
    if (form.elements[name]) form.elements[name].value = view.get(name, USUAL[name] ?? "");
  }
  if (document.activeElement !== form.elements.q) form.elements.q.value = view.get("q");
  markPeriod();
}

function markPeriod() {
  const from = view.get("from");
  const { options } = form.elements.from;
  const isOffered = [...options].some((option) => option.value === from) && !view.get("to");
  if (isOffered && !(from === "" && form.elements.from.value === "own")) form.elements.from.value = from;
  else form.elements.from.value = "own";
  one("#own-period").hidden = form.elements.from.value !== "own";
  for (const input of all("[data-end]")) input.value = fieldText(Date.parse(view.get(input.dataset.end))).slice(0, 16);
}

function choosePeriod(value) {
  one("#own-period").hidden = value !== "own";
  if (value !== "own") look({ from: value, to: null });
}

function change({ target }) {
  const { name, value, dataset } = target;
  if (dataset.end) look({ from: stampOf("from"), to: stampOf("to") });
  else if (name === "from") choosePeriod(value);
  else if (name in USUAL) look({ [name]: value === USUAL[name] ? null : value });
  else if (name === "robot" || name === "team") look({ [name]: value });
}

function stampOf(end) {
  const { value } = one(`[data-end="${end}"]`);
  return fieldStamp(value) || null;
}

function type({ target }) {
  if (target.name !== "q") return;
  clearTimeout(typing);
  typing = setTimeout(() => look({ q: target.value.trim() }, { push: false }), TYPING_MS);
}

/** Tabs and "more" change the list alone; in a new window they are pages of their own. */
function follow(event) {
  const link = event.target.closest("a[data-tab], a[data-more]");
  if (!link || event.ctrlKey || event.metaKey || event.shiftKey) return;
  event.preventDefault();
  if (link.dataset.more) look({ n: link.dataset.more }, { push: false });
  else look({ state: link.dataset.tab === "open" ? null : link.dataset.tab });
}

/** Acknowledge alarms as they are seen; say how many were, and how many somebody changed. */
async function acknowledge(rows, note = "") {
  const asked = rows.map((row) => ask(`/api/v1/alarms/${row.dataset.alarm}/acknowledge`, {
    method: "POST", body: { revision: Number(row.dataset.revision), note },
  }));
  const answers = await Promise.allSettled(asked);
  const done = rows.filter((_, k) => answers[k].status === "fulfilled");
  choice.drop(done.map((row) => row.dataset.alarm));
  report(answers);
  stale();
}

function report(answers) {
  const refused = answers.filter((one) => one.status === "rejected").map((one) => one.reason);
  const changed = refused.filter((error) => error.status === 409).length;
  const done = answers.length - refused.length;
  if (done) toast(counted("alarms.acknowledged", done));
  if (changed) toast(counted("alarms.not_acknowledged", changed), "error");
  for (const error of refused.filter((one) => one.status !== 409)) fail(error, null);
}

const counted = (name, n) => (n === 1 ? t(`${name}_one`) : t(name, { n }));

async function sendBulk(event) {
  event.preventDefault();
  const button = one("button.primary", bulk);
  button.setAttribute("aria-busy", "true");
  await acknowledge(choice.rows(), bulk.elements.note.value);
  button.removeAttribute("aria-busy");
  bulk.elements.note.value = "";
}

form.addEventListener("submit", (event) => event.preventDefault());
form.addEventListener("input", type);
form.addEventListener("change", change);
document.addEventListener("click", follow);
document.addEventListener("click", (event) => {
  const button = event.target.closest("[data-acknowledge]");
  if (button) acknowledge([button.closest(".alarm")]);
});
bulk.addEventListener("submit", sendBulk);
view.on(() => look({}, { push: false }));
keys.start({ acknowledge: (row) => acknowledge([row]), choose: choice.turn });
markPeriod();

const feed = listen({ kinds: ["alarm"] });
for (const kind of ["alarm", "snapshot"]) feed.on(kind, stale);
