// What stands behind "Details" of a diagnosis: one tab at a time, asked for when it is looked at.
// Which one, and what is asked in it, stands in the address.

import { fail } from "../ask.js";
import { all, el, one } from "../dom.js";
import { pieces, replace } from "../pieces.js";
import { t } from "../strings.js";
import * as view from "../view.js";

/** What of the address each tab is about. */
const ABOUT = { tree: ["effect"], rules: ["q", "want"], whatif: ["present", "absent", "unknown", "engine"] };
/** So much of what stands before a tab is seen beside it, in pixels. */
const BESIDE = 48;
/** Tabs that follow what happens; in the others somebody may be writing. */
const FOLLOWING = ["others", "effects", "history"];

/**
 * Start the details. Returns `show()`, which shows what the address says, and `renew()` for
 * when something has happened.
 * @param {{part: (name: string, more?: string[][]) => string, renewed: () => void}} page
 */
export function start({ part, renewed }) {
  const around = one(".dx-details");
  const place = one("#dx-tab");
  let asking = new AbortController();
  let shown = "";

  const current = () => one("[role=tab][aria-selected=true]").dataset.tab;

  async function load(name) {
    asking.abort();
    asking = new AbortController();
    const about = (ABOUT[name] ?? []).flatMap((key) => view.list(key).map((value) => [key, value]));
    if (name !== shown) place.replaceChildren(el("p", { class: "muted", role: "status" }, t("diagnosis.working")));
    place.setAttribute("aria-busy", "true");
    try {
      replace(place, await pieces(part(name, about), { signal: asking.signal }));
      shown = name;
      for (const drawing of all(".dx-drawing", place)) drawing.scrollLeft = middle(drawing, one("svg.faulttree", drawing));
      place.removeAttribute("aria-busy");
      await loadInside(one("[data-load]", place), about);
    } catch (error) {
      if (error.name === "AbortError") return;
      place.removeAttribute("aria-busy");
      place.replaceChildren();
      fail(error, place);
    }
  }

  /** Fetch what of a tab takes a while: the rest of it is there already. */
  async function loadInside(inner, about) {
    if (inner) replace(inner, await pieces(part(inner.dataset.load, about), { signal: asking.signal }));
  }

  function mark(name) {
    for (const tab of all("[role=tab]", around)) {
      const is = tab.dataset.tab === name;
      tab.setAttribute("aria-selected", String(is));
      tab.tabIndex = is ? 0 : -1;
      if (!is) continue;
      place.setAttribute("aria-labelledby", tab.id);
      tab.parentElement.scrollLeft = tab.offsetLeft - tab.parentElement.offsetLeft - BESIDE;
    }
  }

  function choose(name, { push = true } = {}) {
    mark(name);
    view.set({ tab: name }, { push });
    load(name);
  }

  function show() {
    const name = view.get("tab", current());
    if (one(`[data-tab="${CSS.escape(name)}"]`, around)) mark(name);
    around.open = view.get("details") === "1";
    if (around.open) load(current());
  }

  function step(event) {
    const tabs = all("[role=tab]", around);
    const at = tabs.indexOf(event.target);
    const to = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: tabs.length - 1 }[event.key];
    if (at < 0 || to === undefined) return;
    event.preventDefault();
    const next = tabs[(to + tabs.length) % tabs.length];
    next.focus();
    choose(next.dataset.tab, { push: false });
  }

  function ask(event) {
    const form = event.target.closest("form[data-view-form]");
    if (!form) return;
    event.preventDefault();
    const name = form.dataset.viewForm;
    view.set({ ...simple(form), ...(name === "whatif" ? symptoms(form) : {}) }, { push: true });
    form.after(el("p", { class: "muted", role: "status" }, t("diagnosis.working")));
    load(name);
  }

  function press(event) {
    const example = event.target.closest("[data-example]");
    if (example) one("[name=q]", place).value = example.dataset.example;
    if (event.target.closest("[data-clear]")) {
      view.set({ present: null, absent: null, unknown: null, engine: null }, { push: true });
      load("whatif");
    }
    if (event.target.closest("[data-again]")) load(current());
  }

  around.addEventListener("toggle", () => around.open && shown === "" && load(current()));
  one("[role=tablist]", around).addEventListener("click", (event) => {
    const tab = event.target.closest("[role=tab]");
    if (tab) choose(tab.dataset.tab);
  });
  one("[role=tablist]", around).addEventListener("keydown", step);
  place.addEventListener("submit", ask);
  place.addEventListener("click", press);
  place.addEventListener("done", (event) => {
    if (event.target.closest("[data-cause]")) load("cause");
    renewed();
  });
  mark(current());
  if (around.open) load(current());
  return { show, renew: () => around.open && FOLLOWING.includes(current()) && load(current()) };
}

/** Return how far to scroll: the top of a tree stands in the middle, all else begins on the left. */
function middle(drawing, tree) {
  return tree ? (drawing.scrollWidth - drawing.clientWidth) / 2 : 0;
}

/** Return the fields of a form that have a name, as the address has them. */
function simple(form) {
  return Object.fromEntries([...form.elements].filter((field) => field.name).map((field) => [field.name, field.value]));
}

/** Return what is said of symptoms, by what they are taken as. */
function symptoms(form) {
  const found = { present: [], absent: [], unknown: [] };
  for (const choice of all("[data-symptom]", form)) {
    if (choice.value) found[choice.value].push(choice.dataset.symptom);
  }
  const added = one("[data-new]", form).value.trim();
  if (added) found[one("[data-new-state]", form).value].push(added);
  return found;
}
