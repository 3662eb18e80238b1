/** Strips above and below the panels: flags of what happened, and lanes of states. */

import { el, icon, setText } from "./dom.js";
import { moment, since } from "./plottime.js";
import { t } from "./strings.js";

const ICONS = { alarm: "bell", incident: "flag", mission: "robot", note: "note", event: "info" };
const TOGETHER_PX = 22;
const WORD_PX = 6.5;

/** Make the strip of flags, and the same as a list. */
export function flagStrip(stack) {
  const flags = el("div", { class: "plot-flags" });
  const list = el("ul", { class: "plot-list" });
  const summary = el("summary", {}, "");
  const details = el("details", { class: "plot-happened" }, summary, list);
  return { stack, flags, list, summary, details };
}

/** Show the marks of the window. @param {import("./plotmarks.js").Mark[]} marks */
export function showFlags(strip, marks, width) {
  const { from, to } = strip.stack.view;
  const inside = marks.filter((mark) => mark.from <= to && (mark.to ?? mark.from) >= from);
  strip.flags.hidden = !marks.length;
  strip.details.hidden = !marks.length;
  const placed = inside.map((mark) => ({ mark, x: Math.max(0, ((mark.from - from) / (to - from)) * width) }));
  strip.flags.replaceChildren(...grouped(placed).map((group) => flag(strip, group)));
  setText(strip.summary, t("plot.happened", { n: inside.length }));
  strip.list.replaceChildren(...inside.map((mark) => el("li", {}, ...line(strip, mark))));
}

/** Flags that would cover each other become one. */
function grouped(placed) {
  const groups = [];
  for (const one of placed) {
    const last = groups[groups.length - 1];
    if (last && one.x - last[0].x < TOGETHER_PX) last.push(one);
    else groups.push([one]);
  }
  return groups;
}

function flag(strip, group) {
  const [{ mark, x }] = group;
  const worst = group.find((one) => one.mark.kind === "alarm")?.mark ?? mark;
  const lines = group.map((one) => el("span", { class: "plot-flag-line" }, sentence(strip, one.mark)));
  const tip = el("span", { class: "plot-tip" }, ...lines);
  const about = { class: `plot-flag plot-flag-${worst.kind}`, "aria-label": group.map((one) => sentence(strip, one.mark)).join("; ") };
  const alone = group.length === 1 && mark.href;
  const made = el(alone ? "a" : "button", alone ? { ...about, href: mark.href } : { ...about, type: "button" },
    icon(ICONS[worst.kind]), group.length > 1 ? String(group.length) : null, tip);
  if (!alone) made.addEventListener("click", () => strip.stack.cursorTo(mark.from));
  made.style.left = `${x}px`;
  if (x > strip.stack.plotWidth() / 2) made.classList.add("plot-flag-late");
  return made;
}

function sentence({ stack }, mark) {
  return `${timeText(stack, mark.from)} ${t(`plot.kind.${mark.kind}`)}: ${mark.text}`;
}

function line(strip, mark) {
  const goes = el("button", { type: "button", class: "button quiet small num", onclick: () => strip.stack.cursorTo(mark.from) },
    timeText(strip.stack, mark.from));
  const text = mark.href ? el("a", { href: mark.href }, mark.text) : mark.text;
  return [goes, " ", el("span", { class: "muted" }, `${t(`plot.kind.${mark.kind}`)}:`), " ", text];
}

function timeText({ options }, time) {
  return options.relative ? since(time, 0.1) : moment(time, 1);
}

/** Make what holds the lanes of states. */
export function laneStrip(stack) {
  return { stack, root: el("div", { class: "plot-lanes" }) };
}

/** Show lanes. @param {import("./plotmarks.js").Lane[]} lanes */
export function showLanes(strip, lanes, width) {
  strip.root.hidden = !lanes.length;
  strip.root.replaceChildren(...lanes.map((lane) => laneOf(strip, lane, width)));
}

function laneOf({ stack }, lane, width) {
  const { from, to } = stack.view;
  const xOf = (time) => ((Math.min(Math.max(time, from), to) - from) / (to - from)) * width;
  const parts = lane.stretches.filter((one) => one.from < to && one.to > from);
  const bar = el("div", { class: "plot-lane-bar" }, ...parts.map((one) => part(stack, one, xOf)));
  return el("div", { class: "plot-lane", role: "group", "aria-label": t("plot.states_of", { name: lane.label }) },
    el("span", { class: "plot-lane-name clip", title: lane.label }, lane.label), bar);
}

function part(stack, one, xOf) {
  const left = xOf(one.from);
  const wide = Math.max(xOf(one.to) - left, 2);
  const text = `${one.text} · ${timeText(stack, one.from)} – ${timeText(stack, one.to)}`;
  const fits = one.text.length * WORD_PX < wide;
  const made = el("span", { class: `plot-state plot-state-${one.level}`, title: text, role: "img", "aria-label": text },
    fits ? one.text : null);
  made.style.left = `${left}px`;
  made.style.width = `${wide}px`;
  return made;
}
