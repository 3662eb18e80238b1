/** Strips above and below the panels: flags of what happened, and lanes of states. */

import { el, icon, setText } from "../dom.js";
import { moment, since } from "./time.js";
import { t } from "../strings.js";

const ICONS = { alarm: "bell", incident: "flag", mission: "robot", note: "note" };
/** Levels with which there is nothing to see. */
const CALM = new Set(["ok", "unknown"]);
const LASTING = new Set(["mission", "incident"]);
const TOGETHER_PX = 28;
const FLAG_PX = 40;
const WORD_PX = 6.5;

/** Make the strip of flags, and the same as a list. */
export function flagStrip(stack) {
  const flags = el("div", { class: "plot-flags" });
  const list = el("ul", { class: "plot-list" });
  const summary = el("summary", {}, "");
  const details = el("details", { class: "plot-happened" }, summary, list);
  return { stack, flags, list, summary, details };
}

/** Show the marks of the window. @param {import("./marks.js").Mark[]} marks */
export function showFlags(strip, marks, width) {
  const { from, to } = strip.stack.view;
  const inside = marks.filter((mark) => mark.from <= to && (mark.to ?? mark.from) >= from);
  strip.flags.hidden = !marks.length;
  strip.details.hidden = !marks.length;
  const placed = inside.map((mark) => ({ mark, x: Math.max(0, ((mark.from - from) / (to - from)) * width) }));
  const lasting = inside.filter((mark) => LASTING.has(mark.kind)).map((mark) => ({
    key: `span ${mark.id}`, make: () => spanOf(mark), move: (element) => placeSpan(strip, element, mark, width),
  }));
  const groups = grouped(placed);
  keep(strip.flags, [...lasting, ...groups.map((group) => ({
    key: group.map(({ mark }) => `${mark.id} ${mark.text} ${mark.to}`).join("\n"),
    make: () => flag(strip, group), move: (element) => placeFlag(element, group[0].x, width),
  }))]);
  setText(strip.summary, t("plot.happened", { n: inside.length }));
  keep(strip.list, inside.map((mark) => ({
    key: `${mark.id} ${mark.text}`, make: () => el("li", {}, ...line(strip, mark)), move: () => undefined,
  })));
}

/**
 * Keep the children of an element that are the same as before: they keep focus and are only moved.
 * @param {HTMLElement} parent
 * @param {{key: string, make: function(): HTMLElement, move: function(HTMLElement): void}[]} wanted
 */
function keep(parent, wanted) {
  const known = new Map([...parent.children].map((child) => [child.dataset.key, child]));
  const children = wanted.map(({ key, make, move }) => {
    const child = known.get(key) ?? make();
    child.dataset.key = key;
    move(child);
    return child;
  });
  const same = children.length === parent.children.length && children.every((child, n) => parent.children[n] === child);
  if (!same) parent.replaceChildren(...children);
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
  const [{ mark }] = group;
  const worst = group.find((one) => one.mark.kind === "alarm")?.mark ?? mark;
  const lines = group.map((one) => el("span", { class: "plot-flag-line" }, sentence(strip, one.mark)));
  const tip = el("span", { class: "plot-tip" }, ...lines);
  const about = { class: `plot-flag plot-flag-${worst.kind}`, "aria-label": group.map((one) => sentence(strip, one.mark)).join("; ") };
  const alone = group.length === 1 && mark.href;
  const made = el(alone ? "a" : "button", alone ? { ...about, href: mark.href } : { ...about, type: "button" },
    icon(ICONS[worst.kind]), group.length > 1 ? String(group.length) : null, tip);
  if (!alone) made.addEventListener("click", () => strip.stack.cursorTo(mark.from));
  return made;
}

function placeFlag(element, x, width) {
  const isLast = x > width - FLAG_PX;
  element.style.left = isLast ? "auto" : `${x}px`;
  element.style.right = isLast ? `${width - x}px` : "auto";
  element.classList.toggle("plot-flag-late", x > width / 2);
  element.classList.toggle("plot-flag-last", isLast);
}

/** A bar from the beginning to the end of what lasts; the flag and the list say what it is. */
function spanOf(mark) {
  return el("span", { class: `plot-span plot-span-${mark.kind}`, "aria-hidden": "true" });
}

function placeSpan({ stack }, element, mark, width) {
  const xOf = along(stack.view, width);
  const left = xOf(mark.from);
  element.style.left = `${left}px`;
  element.style.width = `${Math.max(xOf(mark.to ?? stack.view.to) - left, 2)}px`;
}

/** Where a time lies on a strip, no farther than its ends. */
function along({ from, to }, width) {
  return (time) => ((Math.min(Math.max(time, from), to) - from) / (to - from)) * width;
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

/** Make what holds the lanes of states: those that were not always fine, and the others folded. */
export function laneStrip(stack) {
  const troubled = el("div", { class: "plot-lanes" });
  const fine = el("div", { class: "plot-lanes" });
  const summary = el("summary", {}, "");
  const details = el("details", { class: "plot-fine" }, summary, fine);
  const root = el("div", { class: "plot-lanes" }, troubled, details);
  root.hidden = true;
  return { stack, root, troubled, fine, summary, details };
}

/** Show lanes. @param {import("./marks.js").Lane[]} lanes */
export function showLanes(strip, lanes, width) {
  const { from, to } = strip.stack.view;
  const isFine = (lane) => lane.stretches.every((one) => one.to <= from || one.from >= to || CALM.has(one.level));
  const [fine, troubled] = [lanes.filter(isFine), lanes.filter((lane) => !isFine(lane))];
  strip.root.hidden = !lanes.length;
  strip.details.hidden = !fine.length;
  setText(strip.summary, t("plot.fine", { n: fine.length }));
  for (const [root, some] of [[strip.troubled, troubled], [strip.fine, fine]]) {
    keep(root, some.map((lane) => ({
      key: lane.id, make: () => laneOf(lane), move: (element) => fillLane(strip, element, lane, width),
    })));
  }
}

function laneOf(lane) {
  return el("div", { class: "plot-lane", role: "group", "aria-label": t("plot.states_of", { name: lane.label }) },
    el("span", { class: "plot-lane-name" }, lane.label), el("div", { class: "plot-lane-bar" }));
}

function fillLane({ stack }, element, lane, width) {
  const { from, to } = stack.view;
  const xOf = along(stack.view, width);
  keep(element.lastElementChild, lane.stretches.filter((one) => one.from < to && one.to > from).map((one) => ({
    key: `${one.from} ${one.to} ${one.text}`, make: () => stateOf(stack, one), move: (child) => placeState(child, one, xOf),
  })));
}

function stateOf(stack, one) {
  const text = `${one.text} · ${timeText(stack, one.from)} – ${timeText(stack, one.to)}`;
  return el("span", { class: `plot-state plot-state-${one.level}`, title: text, role: "img", "aria-label": text });
}

function placeState(element, one, xOf) {
  const left = xOf(one.from);
  const wide = Math.max(xOf(one.to) - left, 2);
  element.style.left = `${left}px`;
  element.style.width = `${wide}px`;
  setText(element, one.text.length * WORD_PX < wide ? one.text : "");
}
