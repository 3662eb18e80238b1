// What changes on the server, as it changes: one socket per page, which comes back by itself.
//
// `data-feed` of the document is `live` or `lost`: lost when nothing was heard for 3 s, whatever
// the network says. Pages grey out what is marked with the class `live` then.

import { signIn } from "./ask.js";
import { all, one } from "./dom.js";
import { nowMs, refresh, rfc3339 } from "./time.js";

const LOST_MS = 3000;
const PATIENCE_MS = [250, 500, 1000, 2000, 4000, 8000];
const ENDED = 4401;

/**
 * Listen to robots (null: all) and kinds (null: all). Returns `on(kind, fn(data, robot))`, and
 * `want({live: {robot: [variables]}})` to ask for something else.
 */
export function listen({ robots = null, kinds = null, live = {} } = {}) {
  const wanted = { robots, kinds, live };
  const listeners = new Map();
  const feed = { socket: null, number: null, tries: 0, heardMs: performance.now() };

  function on(kind, fn) {
    listeners.set(kind, [...(listeners.get(kind) ?? []), fn]);
  }

  function want(change) {
    Object.assign(wanted, change);
    if (feed.socket?.readyState === WebSocket.OPEN) say();
  }

  function say() {
    feed.socket.send(JSON.stringify({ ...wanted, resume: feed.number }));
  }

  function open() {
    const address = new URL("/api/v1/feed", location.href);
    address.protocol = address.protocol.replace("http", "ws");
    feed.socket = new WebSocket(address);
    feed.socket.addEventListener("open", say);
    feed.socket.addEventListener("message", (event) => hear(JSON.parse(event.data)));
    feed.socket.addEventListener("close", (event) => closed(event.code));
  }

  function hear(messages) {
    feed.heardMs = performance.now();
    feed.tries = 0;
    state("live");
    for (const { number, kind, robot, data } of messages) {
      if (kind !== "live") feed.number = number;
      for (const fn of listeners.get(kind) ?? []) fn(data, robot);
    }
  }

  function closed(code) {
    if (code === ENDED) {
      signIn();
      return;
    }
    const wait = PATIENCE_MS[Math.min(feed.tries, PATIENCE_MS.length - 1)];
    feed.tries += 1;
    setTimeout(open, wait);
  }

  function watch() {
    if (performance.now() - feed.heardMs < LOST_MS) return;
    state("lost");
    if (feed.socket.readyState === WebSocket.OPEN) feed.socket.close();
  }

  open();
  setInterval(watch, 500);
  return { on, want };
}

function state(now) {
  const root = document.documentElement;
  if (root.dataset.feed === now) return;
  root.dataset.feed = now;
  const banner = one(".lost-banner");
  if (!banner) return;
  banner.hidden = now !== "lost";
  for (const since of all("[data-feed-since]", banner)) since.dateTime = rfc3339(nowMs() - LOST_MS);
  refresh(banner);
}
