// The bar of the demonstration: break a robot, repair it, and say what to watch for.

import { ask, fail } from "./ask.js";
import { el, one, setText } from "./dom.js";
import { listen } from "./feed.js";

/**
 * @typedef {{robots: {robot: string, fault: string}[], faults: string[]}} View what can be broken, and what is
 */

const form = one("#demo");
if (form) begin(form);

/** @param {HTMLFormElement} form */
function begin(form) {
  /** @type {Map<string, string>} */
  const broken = new Map();
  const show = () => {
    shown(form, broken.get(form.robot.value) ?? "");
    answered(form);
  };
  /** @param {View} view */
  const take = (view) => {
    for (const { robot, fault } of view.robots) broken.set(robot, fault);
    offer(form.robot, view.robots.map(({ robot }) => robot));
    show();
  };
  const change = (method, body) => changed(form, method, body).then(take, (error) => fail(error, form));
  form.robot.addEventListener("change", show);
  one("[data-fold]", form).addEventListener("click", (event) => unfolded(form, event.currentTarget));
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    change("POST", { fault: form.fault.value });
  });
  one("[data-repair]", form).addEventListener("click", () => change("DELETE"));
  ask("/api/v1/demo").then(take, (error) => fail(error, form));
  listen({ kinds: ["diagnosis"] }).on("diagnosis", (_, robot) => {
    if (robot === form.robot.value) answered(form);
  });
}

/** Open or close the bar, which is one line on narrow screens. */
function unfolded(form, button) {
  const isOpen = form.toggleAttribute("data-open");
  button.setAttribute("aria-expanded", String(isOpen));
}

/** Offer the robots that one may see; at first the one that the page is about is chosen. */
function offer(select, robots) {
  const now = select.value || decodeURIComponent(location.pathname.split("/")[2] ?? "");
  select.replaceChildren(...robots.map((robot) => el("option", { value: robot, selected: robot === now }, robot)));
  select.closest("form").hidden = robots.length === 0;
}

/** Break or repair the robot that is chosen. @returns {Promise<View>} */
async function changed(form, method, body) {
  one(":scope > [data-failed]", form)?.remove();
  form.setAttribute("aria-busy", "true");
  try {
    return await ask(`/api/v1/demo/${encodeURIComponent(form.robot.value)}/fault`, { method, body });
  } finally {
    form.removeAttribute("aria-busy");
  }
}

/** Say what is broken in the robot that is chosen, and what comes of it. @param {string} fault */
function shown(form, fault) {
  const option = fault ? one(`option[value="${CSS.escape(fault)}"]`, form.fault) : null;
  one("[data-repair]", form).disabled = !option;
  one("[data-well]", form).hidden = Boolean(option);
  one("[data-broken]", form).hidden = !option;
  if (!option) return;
  option.selected = true;
  const see = one("[data-see]", form);
  see.href = pageOf(form.robot.value);
  see.hidden = location.pathname === see.pathname;
  setText(one("[data-what]", form), option.textContent);
  setText(one("[data-then]", form), option.dataset.watch);
}

/** Lead to the diagnosis of the robot that is chosen, once it is broken and there is one. */
async function answered(form) {
  const robot = form.robot.value;
  const link = one("[data-found]", form);
  const isBroken = robot && !one("[data-broken]", form).hidden;
  const card = isBroken ? await ask(`/api/v1/robots/${encodeURIComponent(robot)}`).catch(() => null) : null;
  if (robot !== form.robot.value) return;
  link.href = `${pageOf(robot)}/diagnosis`;
  link.hidden = !card?.diagnosis;
  if (!link.hidden) one("[data-see]", form).hidden = true; // one way on is enough
}

/** @param {string} robot */
function pageOf(robot) {
  return `/robots/${encodeURIComponent(robot)}`;
}
