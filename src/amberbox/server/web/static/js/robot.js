// The page of a robot: the tree of its components, the panels beside it, its presence, its dialogs.

import { showError } from "./api.js";
import { keepCardCurrent } from "./diagnosis_card.js";
import { find, findAll, setText } from "./dom.js";
import { subscribe } from "./feed.js";
import { fetchFragment, replaceElement, throttledFragment } from "./fragments.js";
import { robotValues } from "./robot_values.js";
import { t } from "./strings.js";
import { localTime, msToStamp, nowMs, updateTimes } from "./time.js";
import { getParam, setParams } from "./url.js";

const TYPE_AHEAD_MS = 600;
const TREE_MS = 2000;
const GRAPH_MS = 2000;
const TIMELINE_MS = 5000;
const CURRENT_MS = 20000;
const TREND_MS = 60000;
const SILENT_S = 10;
const ROW = ".tr[aria-level]";
// in the address: no branch is open
const NONE_OPEN = "-";

/**
 * Give the rows below `root` the keys of a tree: arrows, Home, End, letters. `toggled()` is called
 * after a branch was opened or closed. Returns `open(row, isOpen)`, `focusRow(row)`, `openNames()` of
 * the open branches, and `ensureTabbable()`, to be called after rows were hidden or replaced.
 * @param {HTMLElement} root
 * @param {{toggled: () => void}} options
 */
function treeKeys(root, { toggled }) {
  const typed = { text: "", ms: 0 };

  function rows() {
    return findAll(ROW, root).filter((row) => !row.closest("[hidden]"));
  }

  function open(row, isOpen) {
    row.setAttribute("aria-expanded", String(isOpen));
    find(".inside", row.parentElement).hidden = !isOpen;
  }

  function toggle(row) {
    open(row, row.getAttribute("aria-expanded") !== "true");
    ensureTabbable();
    toggled();
  }

  /** Focus a row, which becomes the one that Tab leads to. */
  function focusRow(row) {
    if (!row) return;
    makeTabbable(row);
    row.focus();
  }

  function makeTabbable(row) {
    for (const other of findAll(`${ROW}[tabindex="0"]`, root)) other.tabIndex = -1;
    row.tabIndex = 0;
  }

  /** Let Tab lead to the first visible row, if the one that it led to is hidden now. */
  function ensureTabbable() {
    const visible = rows();
    if (visible.length && !visible.some((row) => row.tabIndex === 0)) makeTabbable(visible[0]);
  }

  function openOrEnter(row) {
    const state = row.getAttribute("aria-expanded");
    if (state === "false") toggle(row);
    else if (state === "true") step(row, 1);
  }

  function closeOrLeave(row) {
    if (row.getAttribute("aria-expanded") === "true") {
      toggle(row);
      return;
    }
    const before = rows().slice(0, rows().indexOf(row)).reverse();
    focusRow(before.find((other) => other.ariaLevel < row.ariaLevel));
  }

  function step(row, by) {
    const visible = rows();
    focusRow(visible[visible.indexOf(row) + by]);
  }

  /** Focus the next row whose name begins with what was typed. */
  function typeAhead(row, letter) {
    const now = performance.now();
    typed.text = (now - typed.ms < TYPE_AHEAD_MS ? typed.text : "") + letter.toLowerCase();
    typed.ms = now;
    const visible = rows();
    const at = visible.indexOf(row) + (typed.text.length === 1 ? 1 : 0);
    const order = [...visible.slice(at), ...visible.slice(0, at)];
    focusRow(order.find((other) => find(".name", other)?.textContent.trim().toLowerCase().startsWith(typed.text)));
  }

  const keys = {
    ArrowDown: (row) => step(row, 1),
    ArrowUp: (row) => step(row, -1),
    ArrowRight: openOrEnter,
    ArrowLeft: closeOrLeave,
    Home: () => focusRow(rows()[0]),
    End: () => focusRow(rows().at(-1)),
    Enter: (row) => row.hasAttribute("aria-expanded") && toggle(row),
    " ": (row) => row.hasAttribute("aria-expanded") && toggle(row),
  };

  function onKey(event) {
    const row = event.target;
    if (!row.matches(ROW) || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key in keys) keys[event.key](row);
    else if (event.key.length === 1) typeAhead(row, event.key);
    else return;
    event.preventDefault();
  }

  root.addEventListener("keydown", onKey);
  root.addEventListener("focusin", (event) => {
    if (event.target.matches(ROW)) makeTabbable(event.target);
  });
  root.addEventListener("click", (event) => {
    const row = event.target.closest(`${ROW}[aria-expanded]`);
    if (row && !event.target.closest("a, button")) toggle(row);
  });

  const openNames = () => findAll('[aria-expanded="true"]', root).map((row) => row.parentElement.dataset.component);
  return { open, focusRow, openNames, ensureTabbable };
}

/**
 * Start the tree of components below `section` with its form of filters; the address holds what is
 * open and filtered. Returns `filter()`, to be called after levels or rows have changed,
 * `openComponent(name)`, and `query()`, with which the server renders the same.
 * @param {HTMLElement} section
 * @param {HTMLFormElement} form
 */
function startTree(section, form) {
  const rows = treeKeys(section, { toggled: keepOpenInUrl });
  const textCache = new WeakMap();

  function query() {
    const params = new URLSearchParams([["q", getParam("q")], ["show", getParam("show", "all")]]);
    for (const name of openComponents()) params.append("open", name);
    return params;
  }

  function openComponents() {
    const names = rows.openNames();
    return names.length ? names : [NONE_OPEN];
  }

  function keepOpenInUrl() {
    setParams({ open: openComponents() });
  }

  /** Show the components that match the filters, and count those with trouble. */
  function filter() {
    const words = getParam("q").toLowerCase().split(/\s+/).filter(Boolean);
    const isTrouble = getParam("show") === "trouble";
    const branches = findAll(".branch", section);
    for (const branch of branches) {
      const fits = words.every((word) => textOf(branch).includes(word)) && !(isTrouble && branch.dataset.level === "ok");
      if (branch.hidden === fits) branch.hidden = !fits;
    }
    find("#nothing-fits").hidden = branches.length === 0 || branches.some((branch) => !branch.hidden);
    rows.ensureTabbable();
    setText(find("#trouble-count"), String(branches.filter((branch) => branch.dataset.level !== "ok").length));
  }

  function textOf(branch) {
    if (!textCache.has(branch)) textCache.set(branch, findAll(".name", branch).map((name) => name.textContent).join(" ").toLowerCase());
    return textCache.get(branch);
  }

  function changeView(changes) {
    setParams(changes);
    filter();
  }

  /** Open a component and focus its row. */
  function openComponent(name) {
    const branch = find(`.branch[data-component="${CSS.escape(name)}"]`, section);
    if (!branch) return;
    if (branch.hidden) showAll();
    const row = find(".node", branch);
    rows.open(row, true);
    keepOpenInUrl();
    rows.focusRow(row);
    row.scrollIntoView({ block: "center" });
  }

  function showAll() {
    form.elements.q.value = "";
    find("#trouble").setAttribute("aria-pressed", "false");
    changeView({ q: null, show: null });
  }

  function openAll(isOpen) {
    for (const row of findAll(".node", section)) rows.open(row, isOpen);
    rows.ensureTabbable();
    keepOpenInUrl();
  }

  /** Show the checks of a component that hold; at first only those that fail are shown. */
  function showHiddenChecks(row) {
    for (const folded of findAll(".tr[hidden]", row.parentElement)) folded.hidden = false;
    rows.focusRow(find(".about", row.parentElement));
    row.hidden = true;
  }

  section.addEventListener("click", ({ target }) => {
    if (target.closest("[data-unfold]")) showHiddenChecks(target.closest(".rest"));
  });
  form.addEventListener("submit", (event) => event.preventDefault());
  form.elements.q.addEventListener("input", (event) => changeView({ q: event.target.value.trim() }));
  find("#trouble").addEventListener("click", (event) => {
    const pressed = event.currentTarget.getAttribute("aria-pressed") !== "true";
    event.currentTarget.setAttribute("aria-pressed", String(pressed));
    changeView({ show: pressed ? "trouble" : null });
  });
  find("#open-all").addEventListener("click", () => openAll(true));
  find("#close-all").addEventListener("click", () => openAll(false));
  find("#show-all").addEventListener("click", (event) => {
    event.preventDefault();
    showAll();
  });
  rows.ensureTabbable();
  return { filter, openComponent, query };
}

/**
 * Start the panels around the tree: graph, timeline, events, what the robot is doing. Returns the
 * function that refreshes each of them, by its name, and `trend()` for the trend of the battery.
 * @param {string} base path of the robot's fragments
 */
function startPanels(base) {
  const refresh = {
    panels: throttledFragment(() => find("#panels"), () => `${base}/panels`, GRAPH_MS),
    graph: throttledFragment(() => find("#graph"), () => `${base}/graph`, GRAPH_MS),
    timeline: throttledFragment(() => find("#timeline"), timeline, TIMELINE_MS),
    events: throttledFragment(() => find("#events"), () => `${base}/events?${new URLSearchParams({ kind: getParam("kind") })}`),
    now: throttledFragment(() => find("#now"), () => `${base}/now`),
  };

  function timeline() {
    return `${base}/timeline?${new URLSearchParams({ window: getParam("window", "1h"), lanes: getParam("lanes") })}`;
  }

  async function changeTimeline(changes) {
    setParams(changes);
    replaceElement(find("#timeline"), await fetchFragment(timeline()));
  }

  function chooseWindow(event) {
    const chip = event.target.closest("a[data-window]");
    if (!chip) return;
    event.preventDefault();
    for (const other of findAll("a[data-window]", event.currentTarget)) other.removeAttribute("aria-current");
    chip.setAttribute("aria-current", "true");
    changeTimeline({ window: chip.dataset.window === "1h" ? null : chip.dataset.window });
  }

  function chooseLanes(event) {
    const isAll = event.currentTarget.getAttribute("aria-pressed") !== "true";
    event.currentTarget.setAttribute("aria-pressed", String(isAll));
    changeTimeline({ lanes: isAll ? "all" : null });
  }

  async function trend() {
    if (!find("#trend")) return;
    const fresh = await fetchFragment(`${base}/battery`).catch(() => null); // the charge itself is on the page without it
    if (fresh) find("#trend")?.replaceWith(fresh);
  }

  scrollToCause();
  new MutationObserver(scrollToCause).observe(find("#graph").parentElement, { childList: true });
  find("#windows")?.addEventListener("click", chooseWindow);
  find("#lanes")?.addEventListener("click", chooseLanes);
  find("#event-kind")?.addEventListener("change", (event) => {
    setParams({ kind: event.target.value || null });
    refresh.events();
  });
  return { ...refresh, trend };
}

/** Scroll a graph that is wider than its place to the root cause. */
function scrollToCause() {
  const cause = find("#graph .node.root");
  const place = cause?.closest(".scroll");
  if (place) place.scrollLeft += cause.getBoundingClientRect().left - place.getBoundingClientRect().left - place.clientWidth / 4;
}

/**
 * Show since when a robot is offline or silent, so that its values are no longer current. Returns
 * `set(presence)` for the state of its link, and `update()`, to be called now and then.
 * @param {HTMLElement} page
 * @param {() => number | null} newestAge age of the newest status, in s
 */
function trackPresence(page, newestAge) {
  const presence = {
    online: page.dataset.online === "yes", silent: page.dataset.silent === "yes", seenMs: Date.parse(page.dataset.seen),
  };
  /** When the watcher sent its last status, if it is silent. @type {number | null} */
  let silentSinceMs = null;

  // the text gives a time, not an age: screen readers read it at each change
  function update() {
    const text = reason();
    page.classList.toggle("is-silent", text !== "");
    find("#summary").hidden = text !== "";
    find("#silence").hidden = text === "";
    setText(find("#silence span"), text);
  }

  function reason() {
    if (!presence.online) return presence.seenMs ? t("robot.offline", { text: localTime(presence.seenMs) }) : "";
    if (presence.silent) return t("robot.silent_link", { text: localTime(presence.seenMs, "time") });
    const age = newestAge();
    silentSinceMs = age !== null && age > SILENT_S ? (silentSinceMs ?? nowMs() - age * 1000) : null;
    return silentSinceMs === null ? "" : t("robot.silent_watcher", { text: localTime(silentSinceMs, "time") });
  }

  function set({ online, silent = false, seen = null }) {
    if (!online && presence.online && !presence.silent) presence.seenMs = nowMs();
    if (seen) presence.seenMs = Date.parse(seen);
    Object.assign(presence, { online, silent });
    update();
  }

  return { set, update };
}

/**
 * Start the dialogs that buttons of the page name: to mark an incident, to begin and end missions.
 * `done` is called after the form of one was sent.
 * @param {HTMLElement} page
 * @param {() => void} done
 */
function startDialogs(page, done) {
  page.addEventListener("click", (event) => {
    const button = event.target.closest("button[data-act]");
    if (button) openDialog(button.dataset);
  });
  for (const dialog of findAll("dialog")) {
    find("[data-close]", dialog)?.addEventListener("click", () => dialog.close());
    dialog.addEventListener("done", () => {
      dialog.close();
      done();
    });
  }
}

/** Open a dialog with an empty form; `path` is where it is sent. */
function openDialog({ act: name, path }) {
  const dialog = find(`#dialog-${name}`);
  const form = find("form", dialog);
  if (path) form.dataset.post = path;
  form.reset();
  dialog.showModal();
}

/** Replace a place `data-fill="PATH"` by the fragment of that path. @param {HTMLElement} place */
async function fillPlace(place) {
  const address = place.dataset.fill;
  delete place.dataset.fill;
  try {
    replaceElement(place, await fetchFragment(address));
  } catch (error) {
    place.dataset.fill = address; // tried again when it opens again
    place.removeAttribute("aria-busy");
    showError(error, place);
  }
}

/** Fill all such places, those in closed `details` when they open. */
function fillVisible() {
  for (const place of findAll("[data-fill]")) if (!place.closest("details:not([open])")) fillPlace(place);
}

const page = find("#robot");
const { robot } = page.dataset;
const section = find("#tree").parentElement;
const base = `/pieces/robots/${encodeURIComponent(robot)}`;
const treeView = startTree(section, find("#look"));
const values = robotValues(page);
const presence = trackPresence(page, values.newestAge);
const refresh = startPanels(base);
const refreshTree = throttledFragment(() => find("#tree"), () => `${base}/tree?${treeView.query()}`, TREE_MS);
let snapshots = 0;

function onStatuses(statuses) {
  if (!values.write(statuses)) refreshStructure();
}

/** The page shows the first snapshot already, unless a level has changed since it was rendered. */
function onSnapshot(statuses) {
  const before = currentLevels().join();
  onStatuses(statuses);
  if (snapshots > 0 || before !== currentLevels().join()) onLevelsChanged();
  snapshots += 1;
}

function onLevelsChanged() {
  treeView.filter();
  countLevels();
  refresh.graph();
  refresh.timeline();
}

function currentLevels() {
  return findAll(".branch", section).map((branch) => branch.dataset.level);
}

/** Show the number of components of each level. */
function countLevels() {
  const levels = currentLevels();
  for (const element of findAll("[data-count-level]", page)) {
    setText(find("b", element), String(levels.filter((level) => level === element.dataset.countLevel).length));
  }
}

/** The robot has other components or outputs than the page: refresh what shows them. */
function refreshStructure() {
  refreshTree();
  refresh.panels();
  refresh.trend();
}

function onAges(data) {
  values.takeAges(data);
  const place = find("#contact");
  for (const element of findAll("time", place)) element.dateTime = msToStamp(nowMs());
  updateTimes(place);
}

function startFeed() {
  const feed = subscribe({ robots: [robot], kinds: ["presence", "status", "levels", "ages", "event", "diagnosis"] });
  feed.on("snapshot", ({ robots, statuses }) => {
    const card = robots.find((other) => other.robot === robot);
    if (card) presence.set({ online: card.online, silent: card.silent, seen: card.last_seen });
    onSnapshot(statuses[robot] ?? []);
    if (snapshots > 1) onEvent();
  });
  feed.on("status", onStatuses);
  feed.on("levels", onLevelsChanged);
  feed.on("ages", onAges);
  feed.on("presence", ({ online, silent, since }) => {
    presence.set({ online, silent, seen: since });
    refresh.now();
  });
  feed.on("event", onEvent);
  return feed;
}

/** An event has happened, or may have while the feed was lost. */
function onEvent() {
  if (find("#events")) refresh.events();
  refresh.now();
}

function startDiagnosis(feed) {
  const place = find("#diagnosis");
  if (!place) return;
  feed.on("diagnosis", () => {
    place.hidden = false;
  });
  keepCardCurrent(place, { path: () => `/robots/${encodeURIComponent(robot)}/diagnosis/card`, feed, robot });
}

/** Rows or panels were replaced. */
function onReplaced() {
  values.index();
  page.classList.toggle("is-empty", find(".branch", section) === null);
  treeView.filter();
  countLevels();
}

/** Let links to components lead to their rows. */
function followComponentLink(event) {
  const link = event.target.closest("[data-go], .drawing a[href^='#c-']");
  if (!link) return;
  event.preventDefault();
  treeView.openComponent(link.dataset.go ?? decodeURIComponent(link.getAttribute("href").slice("#c-".length)));
}

startDiagnosis(startFeed());
startDialogs(page, refresh.now);
page.addEventListener("click", followComponentLink);
for (const place of [section, find(".robot-side")]) new MutationObserver(onReplaced).observe(place, { childList: true });
setInterval(() => {
  presence.update();
  values.tick(page.classList.contains("is-silent"));
}, 1000);
setInterval(refresh.now, CURRENT_MS);
setInterval(refresh.trend, TREND_MS);
refresh.trend();
if (location.hash.startsWith("#c-")) treeView.openComponent(decodeURIComponent(location.hash.slice(3)));
document.addEventListener("toggle", ({ target }) => {
  if (target.open) fillVisible();
}, true);
fillVisible();
