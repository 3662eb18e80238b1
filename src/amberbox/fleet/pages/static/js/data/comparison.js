/** Choosing two missions to lay over each other. */

import { ask } from "../ask.js";
import { el, one } from "../dom.js";
import { dialogForm } from "../dialogs.js";
import { local } from "../time.js";

const MOST = 50;

/**
 * Make the dialog work, and the button that ends it. @param {string} robot
 * @param {{begin: function(string[]): void, end: function(): void}} to
 */
export function comparing(robot, { begin, end }) {
  dialogForm("compare", {
    async opened(form) {
      const found = await ask(`/api/v1/robots/${encodeURIComponent(robot)}/missions?limit=${MOST}`).catch(() => []);
      ["first", "second"].forEach((name, n) => form.elements[name].replaceChildren(...found.map((mission, k) =>
        el("option", { value: mission.id, selected: k === n }, `${mission.name} · ${local(Date.parse(mission.from))}`))));
      one("[data-none]", form).hidden = found.length > 1;
      one('button[type="submit"]', form).disabled = found.length < 2;
    },
    async send({ first, second }) {
      begin([first, second]);
    },
  });
  one("#end-compare").addEventListener("click", end);
}
