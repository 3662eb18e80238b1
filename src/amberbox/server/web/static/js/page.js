// What every page has: theme, menus, help, forms, times, the number of open alarms, print lines.

import { requestJson } from "./api.js";
import { el, find, findAll, setText } from "./dom.js";
import { startForms } from "./forms.js";
import { enhance, throttledFragment } from "./fragments.js";
import { t } from "./strings.js";
import { localTime, nowMs } from "./time.js";
import { getParam, setParams } from "./url.js";

const YEAR_S = 31536000;
const COUNT_INTERVAL_MS = 60000;
const COUNT_PAUSE_MS = 1000;

function switchTheme() {
  const root = document.documentElement;
  const isDark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = isDark ? "light" : "dark";
  document.cookie = `theme=${root.dataset.theme}; path=/; max-age=${YEAR_S}; SameSite=Lax`;
  dispatchEvent(new Event("themechange"));
}

function closeMenus(event) {
  for (const menu of findAll("details.menu[open]")) {
    if (!menu.contains(event.target)) menu.open = false;
  }
  if (!event.target.closest(".popover, [data-help]")) closeHelp();
}

function closeHelp() {
  find(".popover[data-of-help]")?.remove();
  find("[data-help][aria-describedby]")?.removeAttribute("aria-describedby");
}

/** Explain a word in a popover; where that fails, on the page of all words. */
async function showHelp(event) {
  const link = event.target.closest("a[data-help]");
  if (!link || event.ctrlKey || event.metaKey) return;
  event.preventDefault();
  closeHelp();
  const word = await requestJson(`/help/${encodeURIComponent(link.dataset.help)}`).catch(() => null);
  if (!word) return location.assign(link.href);
  const { title, text } = word;
  const popover = el("div", { class: "popover", role: "status", id: "help-said", "data-of-help": true }, el("strong", {}, title), el("p", {}, text));
  document.body.append(popover);
  link.setAttribute("aria-describedby", popover.id);
  placeBeside(popover, link);
}

function placeBeside(popover, beside) {
  const box = beside.getBoundingClientRect();
  const left = Math.max(8, Math.min(box.left, innerWidth - popover.offsetWidth - 8));
  popover.style.setProperty("left", `${left + scrollX}px`);
  popover.style.setProperty("top", `${box.bottom + scrollY + 6}px`);
}

function onEscape(event) {
  if (event.key !== "Escape") return;
  closeHelp();
  for (const menu of findAll("details.menu[open]")) {
    menu.open = false;
    find("summary", menu).focus();
  }
}

/** Open the dialog that a button names, or close the one that it is in. */
function openDialog(event) {
  const opener = event.target.closest("[data-dialog]");
  if (opener) document.getElementById(opener.dataset.dialog).showModal();
  event.target.closest("[data-closes]")?.closest("dialog").close();
}

/** Keep in the address whether `details` are open. */
function keepOpenInUrl(details) {
  const name = details.dataset.view;
  details.open = getParam(name) === "1" || details.open;
  details.addEventListener("toggle", () => setParams({ [name]: details.open ? "1" : null }));
}

/** Fill in what printed pages show: when, by whom and from where they were printed, and the window. */
function fillPrintLines() {
  const line = find("[data-printed]");
  if (line) setText(line, t("common.printed", { at: dateAndTime(nowMs()), who: line.dataset.printed, address: location.href }));
  const window = find("[data-printed-window]");
  if (window) setText(window, windowText(window.dataset));
}

/** Return the window of time that two fields of the page hold, in the viewer's zone. */
function windowText({ from, to }) {
  const [fromMs, toMs] = [from, to].map((field) => Date.parse(find(field).value));
  if (Number.isNaN(fromMs) || Number.isNaN(toMs)) return "";
  return t("common.printed_window", { from: dateAndTime(fromMs), to: dateAndTime(toMs), zone: Intl.DateTimeFormat().resolvedOptions().timeZone });
}

/** @param {number} ms */
function dateAndTime(ms) {
  return `${localTime(ms, "date")}, ${localTime(ms, "time")}`;
}

const alarmCount = () => find("[data-alarm-count]");

/** Put the number of open alarms before the title of the page. */
function updateTitle() {
  const count = Number(alarmCount()?.dataset.alarmCount ?? 0);
  const plain = document.title.replace(/^\(\d+\) /, "");
  const title = count > 0 ? `(${count}) ${plain}` : plain;
  if (document.title !== title) document.title = title;
}

find("[data-theme-switch]")?.addEventListener("click", switchTheme);
document.addEventListener("click", closeMenus);
document.addEventListener("click", showHelp);
document.addEventListener("click", openDialog);
document.addEventListener("keydown", onEscape);
findAll("details[data-view]").forEach(keepOpenInUrl);
startForms();
addEventListener("beforeprint", fillPrintLines);
enhance();
if (alarmCount()) { // the feed tells of changes; pages without one ask now and then
  const refreshCount = throttledFragment(alarmCount, () => "/pieces/alarm-count", COUNT_PAUSE_MS, updateTitle);
  updateTitle();
  addEventListener("alarmchange", refreshCount);
  document.addEventListener("visibilitychange", () => document.hidden || refreshCount());
  setInterval(() => document.hidden || refreshCount(), COUNT_INTERVAL_MS);
}
