// What one looks for in the tree of a robot: words, trouble, what is open. The address has it all.

import { all, one, setText } from "../dom.js";
import { tree } from "../tree.js";
import * as view from "../view.js";

const NONE = "-";

/**
 * Let one look through the rows below `section` with a form. Returns `filter()`, to be called
 * after levels or rows have changed, `go(name)`, which opens a component, and `query()`, by which
 * the server shows the same.
 * @param {HTMLElement} section
 * @param {HTMLFormElement} form
 */
export function treeLook(section, form) {
  const rows = tree(section, { toggled: remember });
  const words = new WeakMap();

  function query() {
    const asked = new URLSearchParams([["q", view.get("q")], ["show", view.get("show", "all")]]);
    for (const name of chosen()) asked.append("open", name);
    return asked;
  }

  function chosen() {
    const names = rows.opened();
    return names.length ? names : [NONE];
  }

  /** Keep in the address what is open. */
  function remember() {
    view.set({ open: chosen() });
  }

  /** Show what is looked for, and how much trouble there is. */
  function filter() {
    const asked = view.get("q").toLowerCase().split(/\s+/).filter(Boolean);
    const isTrouble = view.get("show") === "trouble";
    const branches = all(".branch", section);
    for (const branch of branches) {
      const fits = asked.every((word) => wordsOf(branch).includes(word)) && !(isTrouble && branch.dataset.level === "ok");
      if (branch.hidden === fits) branch.hidden = !fits;
    }
    one("#nothing-fits").hidden = branches.length === 0 || branches.some((branch) => !branch.hidden);
    rows.tabbable();
    setText(one("#trouble-count"), String(branches.filter((branch) => branch.dataset.level !== "ok").length));
  }

  function wordsOf(branch) {
    if (!words.has(branch)) words.set(branch, all(".name", branch).map((name) => name.textContent).join(" ").toLowerCase());
    return words.get(branch);
  }

  function show(changes) {
    view.set(changes);
    filter();
  }

  /** Open a component and go there. */
  function go(name) {
    const branch = one(`.branch[data-component="${CSS.escape(name)}"]`, section);
    if (!branch) return;
    if (branch.hidden) showAll();
    const row = one(".node", branch);
    rows.open(row, true);
    remember();
    rows.go(row);
    row.scrollIntoView({ block: "center" });
  }

  function showAll() {
    form.elements.q.value = "";
    one("#trouble").setAttribute("aria-pressed", "false");
    show({ q: null, show: null });
  }

  function openAll(isOpen) {
    for (const row of all(".node", section)) rows.open(row, isOpen);
    rows.tabbable();
    remember();
  }

  /** Show what holds beside the checks of a component that fail. */
  function unfold(row) {
    for (const folded of all(".tr[hidden]", row.parentElement)) folded.hidden = false;
    rows.go(one(".about", row.parentElement));
    row.hidden = true;
  }

  function start() {
    section.addEventListener("click", ({ target }) => {
      if (target.closest("[data-unfold]")) unfold(target.closest(".rest"));
    });
    form.addEventListener("submit", (event) => event.preventDefault());
    form.elements.q.addEventListener("input", (event) => show({ q: event.target.value.trim() }));
    one("#trouble").addEventListener("click", (event) => {
      const pressed = event.currentTarget.getAttribute("aria-pressed") !== "true";
      event.currentTarget.setAttribute("aria-pressed", String(pressed));
      show({ show: pressed ? "trouble" : null });
    });
    one("#open-all").addEventListener("click", () => openAll(true));
    one("#close-all").addEventListener("click", () => openAll(false));
    one("#show-all").addEventListener("click", (event) => {
      event.preventDefault();
      showAll();
    });
  }

  start();
  rows.tabbable();
  return { filter, go, query };
}
