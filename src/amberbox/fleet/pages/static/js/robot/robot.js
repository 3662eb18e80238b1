// The page of a robot: its tree follows what it says, what stands around it is fetched anew.

import * as diagnosis from "../diagnosis/card.js";
import { all, one, setText } from "../dom.js";
import { listen } from "../feed.js";
import { keep, piece, put } from "../pieces.js";
import { startActs } from "./acts.js";
import { robotLive } from "./live.js";
import { t } from "../strings.js";
import { local, nowMs, refresh, rfc3339 } from "../time.js";
import { tree } from "../tree.js";
import * as view from "../view.js";

const SILENT_S = 10;
const GRAPH_MS = 2000;
const TIMELINE_MS = 5000;
const NOW_MS = 20000;
const TREND_MS = 300000;
const NONE = "-";

const page = one("#robot");
const { robot } = page.dataset;
const section = one("#tree").parentElement;
const look = one("#look");
const presence = {
  online: page.dataset.online === "yes", silent: page.dataset.silent === "yes", seenMs: Date.parse(page.dataset.seen),
};
const base = `/pieces/robots/${encodeURIComponent(robot)}`;
const rows = tree(section, { toggled: remember });
const live = robotLive(page);
const words = new WeakMap();
let snapshots = 0;
/** Since when the watcher has said nothing. @type {number | null} */
let quietMs = null;

const stale = {
  tree: keep(() => one("#tree"), () => `${base}/tree?${treeQuery()}`, GRAPH_MS),
  panels: keep(() => one("#panels"), () => `${base}/panels`, GRAPH_MS),
  graph: keep(() => one("#graph"), () => `${base}/graph`, GRAPH_MS),
  timeline: keep(() => one("#timeline"), timelineAddress, TIMELINE_MS),
  events: keep(() => one("#events"), () => `${base}/events?${new URLSearchParams({ kind: view.get("kind") })}`),
  now: keep(() => one("#now"), () => `${base}/now`),
};

// -- the tree

function treeQuery() {
  const query = new URLSearchParams([["q", view.get("q")], ["show", view.get("show", "all")]]);
  for (const name of chosen()) query.append("open", name);
  return query;
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
  const query = view.get("q").toLowerCase().split(/\s+/).filter(Boolean);
  const isTrouble = view.get("show") === "trouble";
  const branches = all(".branch", section);
  for (const branch of branches) {
    const fits = query.every((word) => wordsOf(branch).includes(word)) && !(isTrouble && branch.dataset.level === "ok");
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
  look.elements.q.value = "";
  one("#trouble").setAttribute("aria-pressed", "false");
  show({ q: null, show: null });
}

function openAll(isOpen) {
  for (const row of all(".node", section)) rows.open(row, isOpen);
  rows.tabbable();
  remember();
}

function startLook() {
  look.addEventListener("submit", (event) => event.preventDefault());
  look.elements.q.addEventListener("input", (event) => show({ q: event.target.value.trim() }));
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

// -- around it

function timelineAddress() {
  return `${base}/timeline?${new URLSearchParams({ window: view.get("window", "1h"), lanes: view.get("lanes") })}`;
}

async function change(changes, id, address) {
  view.set(changes);
  put(one(id), await piece(address()));
}

function chooseWindow(event) {
  const chip = event.target.closest("a[data-window]");
  if (!chip) return;
  event.preventDefault();
  for (const other of all("a[data-window]", event.currentTarget)) other.removeAttribute("aria-current");
  chip.setAttribute("aria-current", "true");
  change({ window: chip.dataset.window === "1h" ? null : chip.dataset.window }, "#timeline", timelineAddress);
}

function chooseLanes(event) {
  const isAll = event.currentTarget.getAttribute("aria-pressed") !== "true";
  event.currentTarget.setAttribute("aria-pressed", String(isAll));
  change({ lanes: isAll ? "all" : null }, "#timeline", timelineAddress);
}

function startAround() {
  one("#windows")?.addEventListener("click", chooseWindow);
  one("#lanes")?.addEventListener("click", chooseLanes);
  one("#event-kind")?.addEventListener("change", (event) => {
    view.set({ kind: event.target.value || null });
    stale.events();
  });
  page.addEventListener("click", (event) => {
    const link = event.target.closest("[data-go], .drawing a[href^='#c-']");
    if (!link) return;
    event.preventDefault();
    go(link.dataset.go ?? decodeURIComponent(link.getAttribute("href").slice("#c-".length)));
  });
}

/** Show how the battery went; it changes slowly. */
async function showTrend() {
  if (!one("#trend")) return;
  const fresh = await piece(`${base}/battery`).catch(() => null); // the value itself is there without
  if (fresh) one("#trend")?.replaceWith(fresh);
}

// -- what comes

/** Say why nothing counts, if so: since when, not for how long, as it is read aloud at each change. */
function saySilence() {
  const why = silence();
  page.classList.toggle("is-silent", why !== "");
  one("#summary").hidden = why !== "";
  one("#silence").hidden = why === "";
  setText(one("#silence span"), why);
}

function silence() {
  if (!presence.online) return presence.seenMs ? t("robot.offline", { text: local(presence.seenMs) }) : "";
  if (presence.silent) return t("robot.silent_link", { text: local(presence.seenMs, "time") });
  const age = live.newest();
  quietMs = age !== null && age > SILENT_S ? (quietMs ?? nowMs() - age * 1000) : null;
  return quietMs === null ? "" : t("robot.silent_watcher", { text: local(quietMs, "time") });
}

function setPresence({ online, silent = false, seen = null }) {
  if (!online && presence.online && !presence.silent) presence.seenMs = nowMs();
  if (seen) presence.seenMs = Date.parse(seen);
  Object.assign(presence, { online, silent });
  saySilence();
}

function take(statuses) {
  if (!live.write(statuses)) restructure();
}

/** Take how everything is: at first the page shows it already, unless something came in between. */
function takeAll(statuses) {
  const before = levelsNow().join();
  if (!live.write(statuses)) restructure();
  if (snapshots > 0 || before !== levelsNow().join()) changed();
  snapshots += 1;
}

function changed() {
  filter();
  count();
  stale.graph();
  stale.timeline();
}

function levelsNow() {
  return all(".branch", section).map((branch) => branch.dataset.level);
}

/** Count the components by their level. */
function count() {
  const known = levelsNow();
  for (const element of all("[data-count-level]", page)) {
    setText(one("b", element), String(known.filter((level) => level === element.dataset.countLevel).length));
  }
}

/** The robot has other components or outputs than the page: fetch what shows them. */
function restructure() {
  stale.tree();
  stale.panels();
  showTrend();
}

function contact(data) {
  live.take(data);
  const place = one("#contact");
  for (const shown of all("time", place)) shown.dateTime = rfc3339(nowMs());
  refresh(place);
}

function startFeed() {
  const feed = listen({ robots: [robot], kinds: ["presence", "status", "levels", "ages", "event", "diagnosis"] });
  feed.on("snapshot", ({ robots, statuses }) => {
    const card = robots.find((known) => known.robot === robot);
    if (card) setPresence({ online: card.online, silent: card.silent, seen: card.last_seen });
    takeAll(statuses[robot] ?? []);
    if (snapshots > 1) renewAround();
  });
  feed.on("status", take);
  feed.on("levels", changed);
  feed.on("ages", contact);
  feed.on("presence", ({ online, silent, since }) => {
    setPresence({ online, silent, seen: since });
    stale.now();
  });
  feed.on("event", renewAround);
  return feed;
}

/** Something has happened, or may have while nothing was heard. */
function renewAround() {
  if (one("#events")) stale.events();
  stale.now();
}

function startDiagnosis(feed) {
  const place = one("#diagnosis");
  if (!place) return;
  feed.on("diagnosis", () => {
    place.hidden = false;
  });
  diagnosis.keep(place, { path: () => `/robots/${encodeURIComponent(robot)}/diagnosis/card`, feed, robot });
}

/** What was put in place of rows and cells is found anew. */
function indexAnew() {
  live.index();
  page.classList.toggle("is-empty", one(".branch", section) === null);
  filter();
  count();
}

function start() {
  startDiagnosis(startFeed());
  rows.tabbable();
  startLook();
  startAround();
  startActs(page, stale.now);
  for (const place of [section, one(".robot-side")]) new MutationObserver(indexAnew).observe(place, { childList: true });
  setInterval(() => {
    live.tick();
    saySilence();
  }, 1000);
  setInterval(stale.now, NOW_MS);
  setInterval(showTrend, TREND_MS);
  showTrend();
  if (location.hash.startsWith("#c-")) go(decodeURIComponent(location.hash.slice(3)));
}

start();
