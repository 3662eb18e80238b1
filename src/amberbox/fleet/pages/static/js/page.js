// What every page has: its theme, menus, help, times, forms.

import { ask } from "./ask.js";
import { label } from "./cards.js";
import { all, el, one } from "./dom.js";
import * as every from "./every.js";
import * as forms from "./forms.js";
import * as printed from "./printed.js";
import { refresh } from "./time.js";
import * as view from "./view.js";

const YEAR_S = 31536000;

function switchTheme() {
  const root = document.documentElement;
  const isDark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = isDark ? "light" : "dark";
  document.cookie = `theme=${root.dataset.theme}; path=/; max-age=${YEAR_S}; SameSite=Lax`;
  dispatchEvent(new Event("themechange"));
}

function closeMenus(event) {
  for (const menu of all("details.menu[open]")) {
    if (!menu.contains(event.target)) menu.open = false;
  }
  if (!event.target.closest(".popover, [data-help]")) closeHelp();
}

function closeHelp() {
  one(".popover[data-of-help]")?.remove();
  one("[data-help][aria-describedby]")?.removeAttribute("aria-describedby");
}

/** Explain a word where it stands; where that fails, on the page of all words. */
async function explain(event) {
  const link = event.target.closest("a[data-help]");
  if (!link || event.ctrlKey || event.metaKey) return;
  event.preventDefault();
  closeHelp();
  const said = await ask(`/help/${encodeURIComponent(link.dataset.help)}`).catch(() => null);
  if (!said) return location.assign(link.href);
  const { title, text } = said;
  const shown = el("div", { class: "popover", role: "status", id: "help-said", "data-of-help": true }, el("strong", {}, title), el("p", {}, text));
  document.body.append(shown);
  link.setAttribute("aria-describedby", shown.id);
  place(shown, link);
}

function place(shown, beside) {
  const at = beside.getBoundingClientRect();
  const left = Math.max(8, Math.min(at.left, innerWidth - shown.offsetWidth - 8));
  shown.style.setProperty("left", `${left + scrollX}px`);
  shown.style.setProperty("top", `${at.bottom + scrollY + 6}px`);
}

function onKey(event) {
  if (event.key !== "Escape") return;
  closeHelp();
  for (const menu of all("details.menu[open]")) {
    menu.open = false;
    one("summary", menu).focus();
  }
}

/** Open the dialog that a button names; close the one that a button is in. */
function openDialog(event) {
  const opener = event.target.closest("[data-dialog]");
  if (opener) document.getElementById(opener.dataset.dialog).showModal();
  event.target.closest("[data-closes]")?.closest("dialog").close();
}

/** Parts that open, and whose being open stands in the address. */
function remember(details) {
  const name = details.dataset.view;
  details.open = view.get(name) === "1" || details.open;
  details.addEventListener("toggle", () => view.set({ [name]: details.open ? "1" : null }));
}

one("[data-theme-switch]")?.addEventListener("click", switchTheme);
document.addEventListener("click", closeMenus);
document.addEventListener("click", explain);
document.addEventListener("click", openDialog);
document.addEventListener("keydown", onKey);
all("details[data-view]").forEach(remember);
forms.start();
every.start();
printed.start();
refresh();
label();
