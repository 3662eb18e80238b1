/** The variables that are shown: in which plot each stands, and taking it away. */

import { el, icon } from "./dom.js";
import { t } from "./strings.js";
import { breakable } from "./names.js";
import { asDragged } from "./data/variables.js";

const MOST_PLOTS = 12;

/**
 * Show the list inside an element; returns `show(named)`.
 * @param {HTMLElement} element
 * @param {{move: function(string, number): void, remove: function(string): void}} to
 */
export function shownList(element, { move, remove }) {
  element.addEventListener("change", (event) => {
    const { name } = event.target.closest("[data-name]").dataset;
    move(name, Number(event.target.value));
  });
  element.addEventListener("click", (event) => {
    const button = event.target.closest("button[data-remove]");
    if (button) remove(button.closest("[data-name]").dataset.name);
  });
  element.addEventListener("dragstart", (event) => asDragged(event, event.target.dataset.name));

  /** @param {import("./data/view.js").Named[]} named @param {function(string): string} unitOf */
  function show(named, unitOf) {
    const focused = document.activeElement?.closest?.("[data-name]");
    const held = focused && element.contains(focused) ? focused.dataset.name : null;
    const most = Math.max(0, ...named.map((one) => one.plot));
    element.replaceChildren(...named.map((one) => rowOf(one, Math.min(most + 1, MOST_PLOTS), unitOf(one.name))));
    if (held) element.querySelector(`[data-name="${CSS.escape(held)}"] select`)?.focus();
  }
  return { show };
}

function rowOf({ name, plot }, most, unit) {
  const options = Array.from({ length: most }, (_, n) => n + 1).map((number) => el("option", {
    value: number, selected: number === plot }, t(number === most ? "data.shown.new_plot" : "data.shown.plot", { n: number })));
  return el("li", { "data-name": name, draggable: "true" },
    el("span", { class: "shown-name", title: name }, ...breakable(name), unit ? el("span", { class: "muted" }, ` ${unit}`) : null),
    el("select", { "aria-label": t("data.shown.move", { name }) }, ...options),
    el("button", { class: "button quiet icon-only small", type: "button", "data-remove": true, "aria-label": t("data.shown.remove", { name }),
      title: t("data.shown.remove", { name }) }, icon("close")));
}
