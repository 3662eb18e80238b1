/** Live mode: values of the feed are appended, and the window goes along until somebody zooms. */

import { take, trim, wanted } from "./live.js";

const ASK_MS = 5000;

/** @param {any} stack */
export function following(stack) {
  const state = { feed: null, following: false, askedMs: 0, heard: new WeakSet() };
  const traces = () => [...stack.traces.values()];
  const tell = () => stack.options.onLive?.(state.feed ? (state.following ? "on" : "paused") : "off");

  /** Begin with a feed (`feed.js`), or end with null. */
  function start(feed) {
    state.feed?.want({ live: {} });
    state.feed = feed;
    if (feed && !state.heard.has(feed)) {
      state.heard.add(feed);
      feed.on("live", (data, robot) => hear(feed, data, robot));
    }
    state.askedMs = performance.now();
    state.following = Boolean(feed);
    ask();
    tell();
  }

  /** Ask the feed for the variables that are shown now. */
  function ask() {
    state.feed?.want({ live: wanted(traces()) });
  }

  function hear(feed, data, robot) {
    if (feed !== state.feed) return;
    const newest = take(traces(), robot, data);
    if (newest === null) return;
    stack.whole = { ...stack.whole, to: Math.max(stack.whole.to, newest) };
    if (state.following && newest >= stack.view.from) move(newest); // what was last said may be old
    stack.redraw();
  }

  function move(newest) {
    const width = stack.view.to - stack.view.from;
    stack.view = { from: newest - width, to: newest };
    if (performance.now() - state.askedMs < ASK_MS) return;
    state.askedMs = performance.now();
    stack.want();
  }

  /** The window is the user's now. */
  function pause() {
    if (!state.feed || !state.following) return;
    state.following = false;
    tell();
  }

  /** Go along with the newest values again. */
  function follow() {
    if (!state.feed) return;
    state.following = true;
    tell();
  }

  return { start, ask, pause, follow, loaded: trim, isOn: () => state.following };
}
