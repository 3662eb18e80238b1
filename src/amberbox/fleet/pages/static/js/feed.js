// What changes on the server, as it changes: one socket per page, which comes back by itself.
//
// `data-feed` of the document is `live` or `lost`: lost as soon as the socket closes, and when no
// heartbeat was heard for 3 s (the server sends one each second), whatever the network says. Pages
// grey out what is marked with the class `live` then, and say since when.

import { signIn } from "./ask.js";
import { all, one } from "./dom.js";
import { nowMs, refresh, rfc3339 } from "./time.js";

const LOST_MS = 3000;
const HANGS_MS = 10000;
const BANNER_MS = 1000;
const PATIENCE_MS = [250, 500, 1000, 2000, 4000, 8000];
const ENDED = 4401;
const FORBIDDEN = 4403;

/** The one line of a page, whoever of its modules listens. */
const line = { socket: null, number: null, tries: 0, isBack: false, heardMs: performance.now(), openedMs: 0, parts: [] };

/**
 * Listen to robots (null: all) and kinds (null: all). Returns `on(kind, fn(data, robot))`, which
 * returns what ends that, and `want({live: {robot: [variables]}})` to ask for something else. All
 * modules of a page share one socket; who joins later makes everybody hear a new snapshot.
 */
export function listen({ robots = null, kinds = null, live = {} } = {}) {
  const part = { wanted: { robots, kinds, live }, listeners: new Map() };
  line.parts.push(part);
  if (line.socket === null) start();
  else say(null);

  function on(kind, fn) {
    part.listeners.set(kind, [...(part.listeners.get(kind) ?? []), fn]);
    return () => part.listeners.set(kind, part.listeners.get(kind).filter((other) => other !== fn));
  }

  function want(change) {
    Object.assign(part.wanted, change);
    say();
  }

  return { on, want };
}

function start() {
  open();
  setInterval(watch, 500);
  // a page that was out of sight, or a phone that slept, looks at once: its timers stood still
  for (const woken of ["pageshow", "online", "offline"]) addEventListener(woken, watch);
  document.addEventListener("visibilitychange", watch);
}

/** Ask for what all parts want together. */
function say(resume = line.number) {
  if (line.socket.readyState !== WebSocket.OPEN) return;
  line.socket.send(JSON.stringify({ ...together(line.parts.map((part) => part.wanted)), resume }));
}

function together(wants) {
  const of = (name) => (wants.some((one) => one[name] === null) ? null : [...new Set(wants.flatMap((one) => one[name]))]);
  const live = {};
  for (const [robot, names] of wants.flatMap((one) => Object.entries(one.live))) {
    live[robot] = [...new Set([...(live[robot] ?? []), ...names])];
  }
  return { robots: of("robots"), kinds: of("kinds"), live };
}

function open() {
  const address = new URL("/api/v1/feed", location.href);
  address.protocol = address.protocol.replace("http", "ws");
  line.socket = new WebSocket(address);
  line.openedMs = performance.now();
  line.socket.addEventListener("open", () => say());
  line.socket.addEventListener("message", (event) => hear(JSON.parse(event.data)));
  line.socket.addEventListener("close", (event) => closed(event.code));
}

function hear(messages) {
  line.heardMs = performance.now();
  line.tries = 0;
  state("live");
  const isNews = ({ kind }) => kind === "alarm" || (kind === "snapshot" && line.isBack);
  if (messages.some(isNews)) dispatchEvent(new Event("alarmchange"));
  line.isBack = false;
  for (const message of messages) {
    if (message.kind !== "live") line.number = message.number;
    for (const part of line.parts) hand(part, message);
  }
}

function hand({ wanted, listeners }, { kind, robot, data }) {
  if (robot && wanted.robots !== null && !wanted.robots.includes(robot)) return;
  for (const fn of listeners.get(kind) ?? []) fn(data, robot);
}

function closed(code) {
  if (code === ENDED) {
    signIn();
    return;
  }
  if (code === FORBIDDEN) {
    location.reload(); // the page itself says what is not allowed any more
    return;
  }
  state("lost");
  const wait = PATIENCE_MS[Math.min(line.tries, PATIENCE_MS.length - 1)];
  line.tries += 1;
  line.isBack = true; // what was missed meanwhile comes with a snapshot
  setTimeout(open, wait);
}

function watch() {
  if (performance.now() - line.heardMs < LOST_MS) return;
  state("lost");
  const isHanging = line.socket.readyState === WebSocket.CONNECTING && performance.now() - line.openedMs > HANGS_MS;
  if (line.socket.readyState === WebSocket.OPEN || isHanging) line.socket.close();
}

function state(now) {
  const root = document.documentElement;
  if (root.dataset.feed === now) return;
  root.dataset.feed = now;
  const since = rfc3339(nowMs() - (performance.now() - line.heardMs));
  for (const shown of all("[data-feed-since]")) {
    shown.dateTime = since;
    refresh(shown.parentElement);
  }
  if (now === "lost") setTimeout(warn, BANNER_MS);
  else warn();
}

/** Show the banner for as long as nothing is heard; not where the line is back within a second. */
function warn() {
  const banner = one(".lost-banner");
  if (banner) banner.hidden = document.documentElement.dataset.feed !== "lost";
}
