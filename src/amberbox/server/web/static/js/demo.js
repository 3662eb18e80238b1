// The bar of the demonstration: break a robot, repair it, describe what to watch for, and confirm
// motions as somebody at the robot.

import { requestJson, robotApi, showError } from "./api.js";
import { el, find, setText } from "./dom.js";
import { subscribe } from "./feed.js";

/**
 * @typedef {{robots: {robot: string, fault: string, code: string}[], faults: string[]}} View the faults that can be set, those that are, and codes at robots that wait
 */

const form = find("#demo");
if (form) start(form);

/** @param {HTMLFormElement} form */
function start(form) {
  /** @type {Map<string, string>} */
  const faults = new Map();
  const update = () => {
    showFault(form, faults.get(form.robot.value) ?? "");
    showDiagnosisLink(form);
  };
  /** @param {View} view */
  const onState = (view) => {
    for (const { robot, fault } of view.robots) faults.set(robot, fault);
    offerRobots(form.robot, view.robots.map(({ robot }) => robot));
    showWaiting(view);
    update();
  };
  const refresh = () => requestJson("/api/v1/demo").then(onState, (error) => showError(error, form));
  const change = (method, body) => changeFault(form, method, body).then(onState, (error) => showError(error, form));
  form.robot.addEventListener("change", update);
  find("[data-fold]", form).addEventListener("click", (event) => toggleBar(form, event.currentTarget));
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    change("POST", { fault: form.fault.value });
  });
  find("[data-repair]", form).addEventListener("click", () => change("DELETE"));
  find("[data-confirm-motion]")?.addEventListener("click", ({ currentTarget }) => {
    requestJson(`/api/v1/demo/${encodeURIComponent(currentTarget.dataset.robot)}/confirm`, { method: "POST" }).then(onState, refresh);
  });
  refresh();
  const { on } = subscribe({ kinds: ["diagnosis", "command"] });
  on("command", refresh);
  on("diagnosis", (_, robot) => {
    if (robot === form.robot.value) showDiagnosisLink(form);
  });
}

/** Show the first motion that waits for its confirmation, and its code. @param {View} view */
function showWaiting(view) {
  const waiting = view.robots.find(({ code }) => code);
  const line = find("#demo-waits");
  line.hidden = !waiting;
  if (!waiting) return;
  setText(find("[data-robot]", line), waiting.robot);
  setText(find("[data-code]", line), waiting.code);
  const button = find("[data-confirm-motion]", line);
  if (button) button.dataset.robot = waiting.robot;
}

/** Open or close the bar, which is folded on narrow screens. */
function toggleBar(form, button) {
  const isOpen = form.toggleAttribute("data-open");
  button.setAttribute("aria-expanded", String(isOpen));
}

/** Offer the robots that the viewer may see; at first the one of the page is chosen. */
function offerRobots(select, robots) {
  const current = select.value || decodeURIComponent(location.pathname.split("/")[2] ?? "");
  select.replaceChildren(...robots.map((robot) => el("option", { value: robot, selected: robot === current }, robot)));
  select.closest("form").hidden = robots.length === 0;
}

/** Break or repair the chosen robot. @returns {Promise<View>} */
async function changeFault(form, method, body) {
  find(":scope > [data-failed]", form)?.remove();
  form.setAttribute("aria-busy", "true");
  try {
    return await requestJson(`/api/v1/demo/${encodeURIComponent(form.robot.value)}/fault`, { method, body });
  } finally {
    form.removeAttribute("aria-busy");
  }
}

/** Show the fault of the chosen robot and its consequences. @param {string} fault */
function showFault(form, fault) {
  const option = fault ? find(`option[value="${CSS.escape(fault)}"]`, form.fault) : null;
  find("[data-repair]", form).disabled = !option;
  find("[data-well]", form).hidden = Boolean(option);
  find("[data-broken]", form).hidden = !option;
  if (!option) return;
  option.selected = true;
  const robotLink = find("[data-see]", form);
  robotLink.href = robotPath(form.robot.value);
  robotLink.hidden = location.pathname === robotLink.pathname;
  setText(find("[data-what]", form), option.textContent);
  setText(find("[data-then]", form), option.dataset.watch);
}

/** Link to the diagnosis of the chosen robot, once it is broken and has one. */
async function showDiagnosisLink(form) {
  const robot = form.robot.value;
  const link = find("[data-found]", form);
  const isBroken = robot && !find("[data-broken]", form).hidden;
  const card = isBroken ? await requestJson(robotApi(robot)).catch(() => null) : null;
  if (robot !== form.robot.value) return;
  link.href = `${robotPath(robot)}/diagnosis`;
  link.hidden = !card?.diagnosis;
  if (!link.hidden) find("[data-see]", form).hidden = true; // one link is enough
}

/** @param {string} robot */
function robotPath(robot) {
  return `/robots/${encodeURIComponent(robot)}`;
}
