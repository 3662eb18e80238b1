/** Choosing the window by its length, by two times, or live; and in which way it is drawn. */

import { all, one, setText } from "../dom.js";
import { t } from "../strings.js";
import { fieldText, fieldTime } from "../timewords.js";

/**
 * Make the form work. @param {HTMLFormElement} form
 * @param {{newest: function(number): void, go: function(number, number): void, everything: function(): void,
 *   live: function(boolean): void, mode: function(string): void}} to
 */
export function windowForm(form, to) {
  const button = one("#live");
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("click", (event) => {
    const { width, all: isAll } = event.target.closest("button")?.dataset ?? {};
    if (width) to.newest(Number(width));
    if (isAll !== undefined) to.everything();
  });
  form.addEventListener("change", () => {
    const [from, until] = ["from", "to"].map((name) => fieldTime(form.elements[name].value));
    const isRight = from !== null && until !== null && from < until;
    form.elements.to.setCustomValidity(isRight ? "" : t("data.window.wrong"));
    if (isRight) to.go(from, until);
    else form.elements.to.reportValidity();
  });
  button?.addEventListener("click", () => to.live(button.dataset.state !== "on"));
  for (const way of all("[data-mode]")) way.addEventListener("click", () => to.mode(way.dataset.mode));

  return {
    window(from, until) {
      for (const [name, time] of [["from", from], ["to", until]]) {
        const field = form.elements[name];
        if (document.activeElement !== field) field.value = fieldText(time);
        field.setCustomValidity("");
      }
      for (const chip of all("[data-width]", form)) chip.setAttribute("aria-pressed", String(Math.abs(until - from - Number(chip.dataset.width)) < 1));
    },
    live(state) {
      button.dataset.state = state;
      button.setAttribute("aria-pressed", String(state === "on"));
      setText(one(".word", button), t(`data.live.${state}`));
    },
    mode(mode) {
      for (const way of all("[data-mode]")) way.setAttribute("aria-pressed", String(way.dataset.mode === mode));
      button.hidden = mode !== "time";
    },
  };
}
