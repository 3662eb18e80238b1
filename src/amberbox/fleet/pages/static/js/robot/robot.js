// The page of a robot: its tree follows what it says, what stands around it is fetched anew.

import * as diagnosis from "../diagnosis/card.js";
import { all, one, setText } from "../dom.js";
import { listen } from "../feed.js";
import { keep } from "../pieces.js";
import { nowMs, refresh, rfc3339 } from "../time.js";
import { startActs } from "./acts.js";
import { around } from "./around.js";
import { robotLive } from "./live.js";
import { treeLook } from "./look.js";
import { silence } from "./silence.js";

const TREE_MS = 2000;
const NOW_MS = 20000;
const TREND_MS = 60000;

const page = one("#robot");
const { robot } = page.dataset;
const section = one("#tree").parentElement;
const base = `/pieces/robots/${encodeURIComponent(robot)}`;
const look = treeLook(section, one("#look"));
const live = robotLive(page);
const presence = silence(page, live.newest);
const stale = around(base);
const staleTree = keep(() => one("#tree"), () => `${base}/tree?${look.query()}`, TREE_MS);
let snapshots = 0;

function take(statuses) {
  if (!live.write(statuses)) restructure();
}

/** Take how everything is: at first the page shows it already, unless something came in between. */
function takeAll(statuses) {
  const before = levelsNow().join();
  take(statuses);
  if (snapshots > 0 || before !== levelsNow().join()) changed();
  snapshots += 1;
}

function changed() {
  look.filter();
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
  staleTree();
  stale.panels();
  stale.trend();
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
    if (card) presence.set({ online: card.online, silent: card.silent, seen: card.last_seen });
    takeAll(statuses[robot] ?? []);
    if (snapshots > 1) renewAround();
  });
  feed.on("status", take);
  feed.on("levels", changed);
  feed.on("ages", contact);
  feed.on("presence", ({ online, silent, since }) => {
    presence.set({ online, silent, seen: since });
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
  look.filter();
  count();
}

/** Links to components lead to their rows. */
function follow(event) {
  const link = event.target.closest("[data-go], .drawing a[href^='#c-']");
  if (!link) return;
  event.preventDefault();
  look.go(link.dataset.go ?? decodeURIComponent(link.getAttribute("href").slice("#c-".length)));
}

function start() {
  startDiagnosis(startFeed());
  startActs(page, stale.now);
  page.addEventListener("click", follow);
  for (const place of [section, one(".robot-side")]) new MutationObserver(indexAnew).observe(place, { childList: true });
  setInterval(() => {
    presence.say();
    live.tick(page.classList.contains("is-silent"));
  }, 1000);
  setInterval(stale.now, NOW_MS);
  setInterval(stale.trend, TREND_MS);
  stale.trend();
  if (location.hash.startsWith("#c-")) look.go(decodeURIComponent(location.hash.slice(3)));
}

start();
