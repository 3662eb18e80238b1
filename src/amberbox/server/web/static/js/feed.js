// Live updates from the server: one WebSocket per page, which reconnects by itself.
//
// `data-feed` of the document is `live` or `lost`: lost as soon as the socket closes, and when no
// heartbeat was received for 3 s (the server sends one each second). The style sheet greys out
// elements of the class `live` then.

import { signIn } from "./api.js";
import { find, findAll } from "./dom.js";
import { msToStamp, nowMs, updateTimes } from "./time.js";

const LOST_MS = 3000;
const CONNECT_TIMEOUT_MS = 10000;
const BANNER_MS = 1000;
const RETRY_MS = [250, 500, 1000, 2000, 4000, 8000];
const SESSION_ENDED = 4401;
const FORBIDDEN = 4403;

/** The connection of the page, shared by all its modules. */
const connection = { socket: null, number: null, tries: 0, isReconnected: false, receivedMs: performance.now(), openedMs: 0, subscriptions: [] };

/**
 * Subscribe to robots (null: all) and kinds of messages (null: all). Returns `on(kind, fn(data,
 * robot))`, which returns a function that unsubscribes, and `want({live: {robot: [variables]}})`,
 * which changes the request. A later subscription makes the server send a new snapshot to all.
 */
export function subscribe({ robots = null, kinds = null, live = {} } = {}) {
  const subscription = { wanted: { robots, kinds, live }, listeners: new Map() };
  connection.subscriptions.push(subscription);
  if (connection.socket === null) start();
  else sendRequest(null);

  function on(kind, fn) {
    subscription.listeners.set(kind, [...(subscription.listeners.get(kind) ?? []), fn]);
    return () => subscription.listeners.set(kind, subscription.listeners.get(kind).filter((other) => other !== fn));
  }

  function want(change) {
    Object.assign(subscription.wanted, change);
    sendRequest();
  }

  return { on, want };
}

function start() {
  connect();
  setInterval(checkHeartbeat, 500);
  // timers stand still while a page is hidden or a phone sleeps: check at once afterwards
  for (const kind of ["pageshow", "online", "offline"]) addEventListener(kind, checkHeartbeat);
  document.addEventListener("visibilitychange", checkHeartbeat);
}

/** Request what all subscriptions want together. */
function sendRequest(resume = connection.number) {
  if (connection.socket.readyState !== WebSocket.OPEN) return;
  connection.socket.send(JSON.stringify({ ...union(connection.subscriptions.map((subscription) => subscription.wanted)), resume }));
}

function union(wants) {
  const unionOf = (name) => (wants.some((want) => want[name] === null) ? null : [...new Set(wants.flatMap((want) => want[name]))]);
  const live = {};
  for (const [robot, variables] of wants.flatMap((want) => Object.entries(want.live))) {
    live[robot] = [...new Set([...(live[robot] ?? []), ...variables])];
  }
  return { robots: unionOf("robots"), kinds: unionOf("kinds"), live };
}

function connect() {
  const address = new URL("/api/v1/feed", location.href);
  address.protocol = address.protocol.replace("http", "ws");
  connection.socket = new WebSocket(address);
  connection.openedMs = performance.now();
  connection.socket.addEventListener("open", () => sendRequest());
  connection.socket.addEventListener("message", (event) => receive(JSON.parse(event.data)));
  connection.socket.addEventListener("close", (event) => onClose(event.code));
}

function receive(messages) {
  connection.receivedMs = performance.now();
  connection.tries = 0;
  setState("live");
  const isNews = ({ kind }) => kind === "alarm" || (kind === "snapshot" && connection.isReconnected);
  if (messages.some(isNews)) dispatchEvent(new Event("alarmchange"));
  connection.isReconnected = false;
  for (const message of messages) {
    if (message.kind !== "live") connection.number = message.number;
    for (const subscription of connection.subscriptions) deliver(subscription, message);
  }
}

function deliver({ wanted, listeners }, { kind, robot, data }) {
  if (robot && wanted.robots !== null && !wanted.robots.includes(robot)) return;
  for (const fn of listeners.get(kind) ?? []) fn(data, robot);
}

function onClose(code) {
  if (code === SESSION_ENDED) {
    signIn();
    return;
  }
  if (code === FORBIDDEN) {
    location.reload(); // the page explains what is no longer allowed
    return;
  }
  setState("lost");
  const delayMs = RETRY_MS[Math.min(connection.tries, RETRY_MS.length - 1)];
  connection.tries += 1;
  connection.isReconnected = true; // a snapshot brings what was missed
  setTimeout(connect, delayMs);
}

function checkHeartbeat() {
  if (performance.now() - connection.receivedMs < LOST_MS) return;
  setState("lost");
  const isStuck = connection.socket.readyState === WebSocket.CONNECTING && performance.now() - connection.openedMs > CONNECT_TIMEOUT_MS;
  if (connection.socket.readyState === WebSocket.OPEN || isStuck) connection.socket.close();
}

function setState(state) {
  const root = document.documentElement;
  if (root.dataset.feed === state) return;
  root.dataset.feed = state;
  const since = msToStamp(nowMs() - (performance.now() - connection.receivedMs));
  for (const element of findAll("[data-feed-since]")) {
    element.dateTime = since;
    updateTimes(element.parentElement);
  }
  if (state === "lost") setTimeout(updateBanner, BANNER_MS);
  else updateBanner();
}

/** Show the banner while the feed is lost; called after a second, so that short breaks show none. */
function updateBanner() {
  const banner = find(".lost-banner");
  if (banner) banner.hidden = document.documentElement.dataset.feed !== "lost";
}
