/** What there is to say above the plots: nothing chosen, nothing in the window, unknown names. */

import { el, icon } from "../dom.js";
import { t } from "../strings.js";

/**
 * Show notes inside an element, which says with `data-fetch` that one may ask the robot.
 * @param {HTMLElement} element
 * @param {{newest: function(): void, fetch: function(HTMLElement): void}} to
 */
export function notes(element, to) {
  const mayFetch = "fetch" in element.dataset;
  let last = "";

  /** @param {{isEmpty: boolean, unknown: string[], canFetch: boolean}} about */
  function show(about) {
    const key = JSON.stringify(about);
    if (key === last) return;
    last = key;
    element.replaceChildren(...lines(about));
  }

  function* lines({ isEmpty, unknown, canFetch }) {
    for (const name of unknown) yield note("info", t("data.unknown", { name }));
    const offers = canFetch && mayFetch;
    if (isEmpty) yield note("info", t("data.no_values"), button(t("data.to_newest"), () => to.newest()), offers ? asking() : null);
    else if (canFetch) yield note("upload", t(mayFetch ? "data.more_on_robot" : "data.more_on_robot_only"), offers ? asking() : null);
  }

  const asking = () => button(t("data.ask_robot"), (event) => to.fetch(event.target.closest(".data-note")));
  return { show };
}

/** Offer variables to begin with. @param {import("./variablelist.js").Variable[]} variables */
export function emptyStage(element, variables, toggle) {
  element.querySelector("[data-suggested]").replaceChildren(...variables.map((variable) =>
    el("li", {}, button(variable.unit ? `${variable.address} ${variable.unit}` : variable.address, () => toggle(variable.address), "chart"))));
}

function note(picture, text, ...buttons) {
  return el("div", { class: "notice row data-note" }, icon(picture), el("span", {}, text), ...buttons);
}

function button(text, act, picture = "") {
  return el("button", { class: "button small", type: "button", onclick: act }, picture ? icon(picture) : null, el("span", { class: "clip" }, text));
}
