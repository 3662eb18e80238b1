// The diagnosis of a robot: its card, and the details, one tab at a time.

import { latestSignal, showError } from "./api.js";
import { keepCardCurrent } from "./diagnosis_card.js";
import { el, find, findAll } from "./dom.js";
import { subscribe } from "./feed.js";
import { fetchNodes, replaceContent } from "./fragments.js";
import { t } from "./strings.js";
import { fieldToStamp, msToField } from "./time.js";
import { getParam, getParams, onNavigation, setParams } from "./url.js";

// parameters of the address that each tab takes
const TAB_PARAMS = { tree: ["effect"], rules: ["q", "want"], whatif: ["present", "absent", "unknown", "engine"] };
// how much of the tab before the selected one is visible
const TAB_MARGIN_PX = 48;
// tabs that are renewed with each diagnosis; in the others somebody may be writing
const RENEWED_TABS = ["others", "effects", "history"];

/**
 * Start the tabs of the details, loaded when they are selected; the address holds which one, and
 * its queries. Returns `show()`, which shows the tab of the address, and `renew()`.
 * @param {{part: (name: string, more?: string[][]) => string, renewed: () => void}} page
 */
function startDetails({ part, renewed }) {
  const details = find(".dx-details");
  const place = find("#dx-tab");
  const nextSignal = latestSignal();
  let loaded = "";

  const currentTab = () => find("[role=tab][aria-selected=true]").dataset.tab;

  async function loadTab(name) {
    const signal = nextSignal();
    const params = (TAB_PARAMS[name] ?? []).flatMap((key) => getParams(key).map((value) => [key, value]));
    if (name !== loaded) place.replaceChildren(el("p", { class: "muted", role: "status" }, t("diagnosis.working")));
    place.setAttribute("aria-busy", "true");
    try {
      replaceContent(place, await fetchNodes(part(name, params), { signal }));
      loaded = name;
      for (const drawing of findAll(".dx-drawing", place)) { // the root of a fault tree stands in the middle
        drawing.scrollLeft = find("svg.faulttree", drawing) ? (drawing.scrollWidth - drawing.clientWidth) / 2 : 0;
      }
      place.removeAttribute("aria-busy");
      const slow = find("[data-load]", place);
      if (slow) replaceContent(slow, await fetchNodes(part(slow.dataset.load, params), { signal }));
    } catch (error) {
      if (error.name === "AbortError") return;
      place.removeAttribute("aria-busy");
      place.replaceChildren();
      showError(error, place);
    }
  }

  function selectTab(name) {
    for (const tab of findAll("[role=tab]", details)) {
      const isSelected = tab.dataset.tab === name;
      tab.setAttribute("aria-selected", String(isSelected));
      tab.tabIndex = isSelected ? 0 : -1;
      if (!isSelected) continue;
      place.setAttribute("aria-labelledby", tab.id);
      tab.parentElement.scrollLeft = tab.offsetLeft - tab.parentElement.offsetLeft - TAB_MARGIN_PX;
    }
  }

  function chooseTab(name, { push = true } = {}) {
    selectTab(name);
    setParams({ tab: name }, { push });
    loadTab(name);
  }

  function show() {
    const name = getParam("tab", currentTab());
    if (find(`[data-tab="${CSS.escape(name)}"]`, details)) selectTab(name);
    details.open = getParam("details") === "1";
    if (details.open) loadTab(currentTab());
  }

  function onTabKey(event) {
    const tabs = findAll("[role=tab]", details);
    const at = tabs.indexOf(event.target);
    const to = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: tabs.length - 1 }[event.key];
    if (at < 0 || to === undefined) return;
    event.preventDefault();
    const next = tabs[(to + tabs.length) % tabs.length];
    next.focus();
    chooseTab(next.dataset.tab, { push: false });
  }

  function onQuery(event) {
    const form = event.target.closest("form[data-view-form]");
    if (!form) return;
    event.preventDefault();
    const name = form.dataset.viewForm;
    setParams({ ...namedFields(form), ...(name === "whatif" ? symptomFields(form) : {}) }, { push: true });
    form.after(el("p", { class: "muted", role: "status" }, t("diagnosis.working")));
    loadTab(name);
  }

  function onPress(event) {
    const example = event.target.closest("[data-example]");
    if (example) find("[name=q]", place).value = example.dataset.example;
    if (event.target.closest("[data-clear]")) {
      setParams({ present: null, absent: null, unknown: null, engine: null }, { push: true });
      loadTab("whatif");
    }
    if (event.target.closest("[data-again]")) loadTab(currentTab());
  }

  details.addEventListener("toggle", () => details.open && loaded === "" && loadTab(currentTab()));
  find("[role=tablist]", details).addEventListener("click", (event) => {
    const tab = event.target.closest("[role=tab]");
    if (tab) chooseTab(tab.dataset.tab);
  });
  find("[role=tablist]", details).addEventListener("keydown", onTabKey);
  place.addEventListener("submit", onQuery);
  place.addEventListener("click", onPress);
  place.addEventListener("done", (event) => {
    if (event.target.closest("[data-cause]")) loadTab("cause");
    renewed();
  });
  selectTab(currentTab());
  if (details.open) loadTab(currentTab());
  return { show, renew: () => details.open && RENEWED_TABS.includes(currentTab()) && loadTab(currentTab()) };
}

/** Return the fields of a form that have a name, as parameters of the address. */
function namedFields(form) {
  return Object.fromEntries([...form.elements].filter((field) => field.name).map((field) => [field.name, field.value]));
}

/** Return symptoms by the state in which they are assumed. */
function symptomFields(form) {
  const found = { present: [], absent: [], unknown: [] };
  for (const choice of findAll("[data-symptom]", form)) {
    if (choice.value) found[choice.value].push(choice.dataset.symptom);
  }
  const added = find("[data-new]", form).value.trim();
  if (added) found[find("[data-new-state]", form).value].push(added);
  return found;
}

const page = find("#dx");
const robot = page.dataset.robot;
const base = `/robots/${encodeURIComponent(robot)}/diagnosis`;
const place = find("#dx-card");

/** Return the path of a part, for the diagnosis and the moment of the page. */
function partPath(name, more = []) {
  const query = new URLSearchParams(["diagnosis", "at"].map((key) => [key, getParam(key)]).filter(([, value]) => value));
  for (const [key, value] of more) query.append(key, value);
  const text = query.toString();
  return `${base}/${name}${text ? `?${text}` : ""}`;
}

/** Load the page for another moment. */
function onMoment(event) {
  event.preventDefault();
  const { value } = event.target.elements.at;
  const query = new URLSearchParams(location.search);
  for (const key of ["diagnosis", "at"]) query.delete(key);
  if (value) query.set("at", fieldToStamp(value));
  location.assign(`${base}?${query}`);
}

function startMomentForm() {
  const form = find("#dx-moment");
  const { at } = find("[name=at]", form).dataset;
  form.elements.at.value = msToField(Date.parse(at));
  form.addEventListener("submit", onMoment);
}

if (place) {
  const feed = getParam("at") ? null : subscribe({ robots: [robot], kinds: ["diagnosis", "presence"] });
  const tab = startDetails({ part: partPath, renewed: () => renew() });
  const renew = keepCardCurrent(place, { path: () => partPath("card"), feed, renewed: tab.renew, robot });
  startMomentForm();
  onNavigation(tab.show);
}
