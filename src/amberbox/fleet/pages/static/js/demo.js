// The bar of the demonstration: break a robot, repair it, and say what to watch for.

import { ask, fail } from "./ask.js";
import { el, one, setText } from "./dom.js";

/**
 * @typedef {{robots: {robot: string, fault: string}[], faults: string[]}} View what can be broken, and what is
 */

const form = one("#demo");
if (form) begin(form);

/** @param {HTMLFormElement} form */
function begin(form) {
  /** @type {Map<string, string>} */
  const broken = new Map();
  const show = () => shown(form, broken.get(form.robot.value) ?? "");
  /** @param {View} view */
  const take = (view) => {
    for (const { robot, fault } of view.robots) broken.set(robot, fault);
    offer(form.robot, view.robots.map(({ robot }) => robot));
    show();
  };
  const change = (method, body) => changed(form, method, body).then(take, (error) => fail(error, form));
  form.robot.addEventListener("change", show);
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    change("POST", { fault: form.fault.value });
  });
  one("[data-repair]", form).addEventListener("click", () => change("DELETE"));
  ask("/api/v1/demo").then(take, (error) => fail(error, form));
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
  setText(one("[data-what]", form), option.textContent);
  setText(one("[data-then]", form), option.dataset.watch);
}
