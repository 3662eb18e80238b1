/** The data page: what the address says is shown, and what people do goes into the address. */

import { ask, clear, fail } from "../ask.js";
import { comparing } from "./comparison.js";
import { askCoverage, lacks } from "./coverage.js";
import { brush } from "./brush.js";
import { read, tidy, write } from "./view.js";
import { drawn, stage } from "./stage.js";
import { brought, one } from "../dom.js";
import { listen } from "../feed.js";
import { meaning, newestEnd, whole } from "./window.js";
import { goTo } from "./goto.js";
import { marks } from "./marks.js";
import { emptyStage, notes } from "./notes.js";
import { recent, used } from "./recent.js";
import { sane } from "../plot/view.js";
import { shownList } from "../shownlist.js";
import { takeAlong } from "./takealong.js";
import { nowMs } from "../time.js";
import { stamp } from "../timewords.js";
import { tree } from "./variables.js";
import { find, loadItems, reach, suggested } from "./variablelist.js";
import * as view from "../view.js";
import { windowForm } from "./windowform.js";
import { works } from "../works.js";

const HOUR_S = 3600;
const AGAIN_MS = 60_000;
const FOLLOW_MS = 1000;
const GESTURE_MS = 1500;
const NARROW = "(max-width: 60rem)";
const { robot, named: fromDiagnosis } = brought("data-about");
const path = `/api/v1/robots/${encodeURIComponent(robot)}`;
const now = () => nowMs() / 1000;

const page = {
  look: read(), items: [], reach: { first: null, last: null }, cover: null, window: { from: now() - HOUR_S, to: now() },
  missions: [], parts: {}, isEmpty: false, live: "off", follows: 0, movedMs: -GESTURE_MS,
};

start();

function start() {
  begin().catch(refused);
}

async function begin() {
  page.items = await loadItems(robot);
  page.reach = reach(page.items);
  const isEmpty = !page.items.length;
  one("#data-nothing").hidden = !isEmpty;
  one("#data").hidden = isEmpty;
  if (isEmpty) {
    setTimeout(start, AGAIN_MS);
    return;
  }
  build();
  if (page.look.named.length && matchMedia(NARROW).matches) one("#data-side").open = false;
  await again();
  view.on(again);
  setInterval(renewIfNewer, AGAIN_MS);
  setInterval(followed, FOLLOW_MS);
  if (chosen().length && page.look.mode === "time") await drawn(one("#plots"));
  covered(await askCoverage(robot));
}

function refused(error) {
  fail(error, one("#data-problem"));
}

/** Make all parts; none of them shows anything yet. */
function build() {
  const { parts } = page;
  parts.feed = listen({ robots: [robot], kinds: ["alarm", "job", "fetch"] });
  parts.stage = stage(one("#plots"), {
    onWindow: (from, to) => move(from, to, "plots"), onRemove: (name) => toggle(name), onLive: showLive,
    onEmpty: (isEmpty) => say({ isEmpty }), onMoved: followed, onDrop: dropped, onAxes: (x, y) => change({ x, y }),
  });
  parts.brush = brush(one("#brush"), (from, to, isMoving) => move(from, to, isMoving ? "moving" : "brush"));
  parts.form = windowForm(one("#window"), {
    newest, go: (from, to) => move(from, to), live: (isOn) => live(isOn), everything: () => move(...ends(everything())),
    mode: (mode) => (page.look.compare.length ? turn({ mode, compare: [] }) : change({ mode })),
  });
  parts.shown = shownList(one("#shown"), { move: (name, plot) => arrange(name, plot), remove: toggle });
  parts.tree = tree(one("#variables"), { robot, items: page.items, first: firstOnes(), toggle, open: page.look.named.length ? "" : `item:${page.items[0].name}` });
  parts.notes = notes(one("#data-notes"), { newest, fetch: fetchWindow });
  parts.works = works(one("#works"), robot, { fetched: renew });
  one("#search").addEventListener("input", (event) => parts.tree.search(event.target.value));
  goTo(one("#goto"), robot, (from, to, mission) => (mission ? turn({ mission, from: "", to: "", live: false }) : move(from, to)));
  const about = { window: () => page.window, cursor: () => parts.stage.plots()?.now().cursor ?? null };
  marks(robot, { ...about, changed: rewatch });
  takeAlong(robot, { ...about, chosen: () => chosen().map((one) => one.variable), began: parts.works.download });
  comparing(robot, { begin: (pair) => turn({ compare: pair, mode: "time", live: false }), end: () => turn({ compare: [] }) });
  for (const kind of ["job", "fetch"]) parts.feed.on(kind, ({ id }) => parts.works.look(id));
  parts.feed.on("snapshot", () => parts.works.lookAll());
  parts.feed.on("alarm", rewatch);
}

function firstOnes() {
  return [
    { id: "diagnosis", title: one("#variables").dataset.diagnosis, addresses: fromDiagnosis },
    { id: "recent", title: one("#variables").dataset.recent, addresses: recent(robot) },
  ];
}

/** Show what an address says. @param {import("./view.js").Look} asked */
async function follow(asked) {
  const number = (page.follows += 1);
  clear(one("#data-problem"));
  const meant = await meaning(asked, path, times(), refused);
  if (number !== page.follows) return; // something else is looked at meanwhile
  const { look } = Object.assign(page, meant);
  if (!look.live) live(false, false);
  const known = look.named.map((one) => ({ ...one, name: find(page.items, one.name)?.address ?? one.name }));
  const seen = new Set();
  look.named = tidy(known.filter((one) => !seen.has(one.name) && seen.add(one.name)));
  used(robot, chosen().map((one) => one.name));
  show();
}

/** Look at something else, for which the server has to be asked first. */
function turn(changes) {
  write({ ...page.look, ...changes }, { push: true });
  return again();
}

/** Show what the address says now. */
function again() {
  return follow(read()).catch(refused);
}

const chosen = () => page.look.named.map((one) => ({ ...one, variable: find(page.items, one.name) })).filter((one) => one.variable?.kind);
const ends = ({ from, to }) => [from, to];

const everything = () => whole(page.cover, page.reach, page.window);
const times = () => ({ now: now(), last: page.reach.last });

/** Show everything as the page is now. */
function show() {
  const { look, parts } = page;
  followed();
  const scene = { robot, look, chosen: chosen(), window: page.window, whole: everything(), missions: page.missions, items: page.items };
  one("#data").classList.toggle("data-comparing", look.compare.length > 0);
  one("#comparing").hidden = !look.compare.length;
  parts.stage.show(scene);
  if (look.mode === "time" && !look.compare.length) live(look.live, false);
  parts.tree.check(look.named.map((one) => one.name));
  parts.shown.show(look.named, (name) => find(page.items, name)?.unit ?? "");
  parts.form.mode(look.mode);
  showWindow();
  say({ isEmpty: false, unknown: look.named.filter((one) => !find(page.items, one.name)?.kind).map((one) => one.name) });
  emptyStage(one("#data-empty"), look.named.length ? [] : suggestions(), toggle);
  const isBare = !look.named.length && look.mode !== "xy"; // where two are chosen from all
  one("#data-empty").hidden = !isBare;
  one("#plots").hidden = isBare;
}

function suggestions() {
  const named = fromDiagnosis.map((name) => find(page.items, name)).filter((one) => one?.kind);
  return [...new Set([...named, ...suggested(page.items)])].slice(0, 8);
}

function showWindow() {
  const { from, to } = page.window;
  page.parts.brush.window(from, to);
  page.parts.form.window(from, to);
}

/** Change what is looked at: one step that "back" undoes. @param {Partial<import("./view.js").Look>} changes */
function change(changes) {
  Object.assign(page.look, changes);
  write(page.look, { push: true });
  show();
}

/** Show or do not show a variable. @param {string} name */
function toggle(name) {
  const { named } = page.look;
  const isShown = named.some((one) => one.name === name);
  const next = isShown ? named.filter((one) => one.name !== name) : [...named, { name, plot: Math.max(0, ...named.map((one) => one.plot)) + 1 }];
  if (!isShown) used(robot, [name]);
  change({ named: tidy(next) });
}

/** Put a variable into a plot; 0 is one of its own. */
function arrange(name, plot) {
  const rest = page.look.named.filter((one) => one.name !== name);
  const own = Math.max(0, ...page.look.named.map((one) => one.plot)) + 1;
  change({ named: tidy([...rest, { name, plot: plot || own }]) });
}

function dropped(name, plot) {
  used(robot, [name]);
  arrange(name, plot);
}

/** The window has moved, by the hand of the user. @param {"plots"|"brush"|"moving"} [by] */
function move(begin, end, by = "brush") {
  const { from, to } = (page.window = sane({ from: begin, to: end }));
  const stack = page.parts.stage.plots();
  if (by !== "plots" && stack && !page.look.compare.length) stack.window(from, to, { soft: by === "moving" });
  if (by === "moving") {
    page.parts.form.window(from, to);
    return;
  }
  if (page.look.compare.length) return;
  if (page.live !== "on") Object.assign(page.look, { from: stamp(from), to: stamp(to), mission: "", live: false });
  write(page.look, { push: isNewMove() });
  showWindow();
  if (!stack) show();
  say({ isEmpty: false });
}

/** Tell whether a move is one of its own: those that follow each other fast are one step back. */
function isNewMove() {
  const before = page.movedMs;
  page.movedMs = performance.now();
  return page.movedMs - before > GESTURE_MS;
}

/** Go to the newest data. @param {number} [width] seconds */
function newest(width = page.window.to - page.window.from) {
  const lasts = chosen().map((one) => page.items.find((item) => item.name === one.variable.item)?.last).filter(Boolean);
  const end = lasts.length && page.isEmpty ? Math.max(...lasts) + width * 0.02 : newestEnd(width, times());
  move(end - width, end);
}

/** Plots have moved by themselves, with live values. */
function followed() {
  const stack = page.parts.stage.plots();
  if (page.live !== "on" || !stack) return;
  const { from, to } = stack.now();
  if (to === page.window.to) return;
  page.window = { from, to };
  showWindow();
}

/** Go along with what comes, or stop it. */
function live(isOn, isByHand = true) {
  const stack = page.parts.stage.plots();
  if (!stack || (isOn && page.live === "on")) return;
  if (isOn && page.live === "paused") stack.follow();
  else if (isOn || page.live !== "off") stack.live(isOn ? page.parts.feed : null);
  if (!isByHand) return;
  const width = Math.round(page.window.to - page.window.from);
  if (isOn) {
    page.window = { from: now() - width, to: now() };
    stack.window(page.window.from, page.window.to, { silent: true });
    showWindow();
  }
  Object.assign(page.look, isOn ? { live: true, from: `now-${width}s`, to: "now", mission: "" }
    : { live: false, from: stamp(page.window.from), to: stamp(page.window.to) });
  write(page.look, { push: true });
}

function showLive(state) {
  page.live = state;
  page.parts.form.live(state);
}

/** Say above the plots what there is to say. */
function say(changes) {
  Object.assign(page, changes);
  const { isEmpty, unknown = [], window } = page;
  page.parts.notes.show({
    isEmpty: isEmpty && page.look.mode === "time" && page.live !== "on", unknown,
    canFetch: page.cover !== null && !page.look.compare.length && lacks(page.cover, window, now()) && !page.parts.works.isAsking(),
  });
}

async function fetchWindow(near) {
  const { from, to } = page.window;
  try {
    page.parts.works.fetch(await ask(`${path}/fetches`, { method: "POST", body: { from: stamp(from), to: stamp(to) } }));
    say({});
  } catch (error) {
    fail(error, near);
  }
}

/** Something has come from the robot: everything is asked for anew. */
async function renew() {
  covered(await askCoverage(robot));
  page.parts.stage.plots()?.refresh();
}

/** Look whether more has come meanwhile; plots that reach so far are drawn anew. */
async function renewIfNewer() {
  if (document.hidden) return;
  const before = page.cover?.end ?? 0;
  covered(await askCoverage(robot));
  if (page.cover?.end > before && page.window.to > before && !page.look.compare.length) page.parts.stage.plots()?.refresh();
}

/** @param {?import("./coverage.js").Coverage} cover */
function covered(cover) {
  if (!cover) return; // asked again in a minute
  page.cover = cover;
  page.reach.last = cover.end === null ? page.reach.last : Math.max(page.reach.last ?? cover.end, cover.end);
  const { from, to } = everything();
  page.parts.brush.cover({ ...page.cover, start: from, end: Math.max(to, Math.min(page.window.to, now())) });
  page.parts.stage.plots()?.setWhole(page.look.compare.length ? page.parts.stage.plots().now() : { from, to });
  say({});
}

/** Ask anew what happened beside the values. */
function rewatch() {
  if (!page.look.compare.length) page.parts.stage.plots()?.watch(robot);
}
