/** Taking data along: what is seen, or whole missions, made by the server into a file. */

import { ask } from "../ask.js";
import { el, one, setText } from "../dom.js";
import { dialogForm } from "../dialogs.js";
import { moment } from "../plot/time.js";
import { t } from "../strings.js";
import { local } from "../time.js";
import { stamp } from "../timewords.js";

const MISSIONS = 50;
const MOST_ROWS = 5_000_000;

/**
 * Make the dialog work. @param {string} robot
 * @param {{window: function(): {from: number, to: number},
 *   chosen: function(): import("./variablelist.js").Variable[], began: function(any): void}} about
 */
export function takeAlong(robot, { window, chosen, began }) {
  dialogForm("download", {
    opened(form) {
      const { from, to } = window();
      const names = chosen().map((variable) => variable.address);
      setText(one("[data-span]", form), t("data.span", { from: moment(from, 1), to: moment(to, 1) }));
      setText(one("[data-names]", form), names.length ? names.join(", ") : t("data.download.everything"));
      direct(one("[data-direct]", form), robot, chosen(), { from, to });
      toggle(form);
      form.onchange = () => toggle(form);
      listMissions(form, robot);
    },
    async send(fields) {
      const body = fields.what === "view" ? ofView(fields, chosen(), window()) : { missions: fields.missions };
      began(await ask("/api/v1/downloads", { method: "POST", body: { robots: [robot], format: fields.format, ...body } }));
    },
  });
}

/** Exactly what is seen: the window, and of each item the variables. */
function ofView({ format }, variables, { from, to }) {
  const groups = Map.groupBy(variables, (variable) => variable.item);
  const columns = Object.fromEntries([...groups].map(([item, group]) => [item, group.map((one) => one.name)]));
  return { items: [...groups.keys()], variables: format === "mcap" ? {} : columns, from: stamp(from), to: stamp(to) };
}

/** Links that give a file at once, one for each item. */
function direct(place, robot, variables, { from, to }) {
  const links = [...Map.groupBy(variables, (variable) => variable.item)].map(([item, group]) => {
    const query = new URLSearchParams({ item, from: stamp(from), to: stamp(to), format: "csv", limit: MOST_ROWS });
    for (const variable of group) query.append("variables", variable.name);
    return el("a", { href: `/api/v1/robots/${encodeURIComponent(robot)}/query?${query}`, download: true }, t("data.download.at_once", { item }));
  });
  place.replaceChildren(...links.map((link) => el("li", {}, link)));
  place.parentElement.hidden = !links.length;
}

function toggle(form) {
  const isView = form.elements.what.value === "view";
  for (const part of form.querySelectorAll("[data-for]")) part.hidden = (part.dataset.for === "view") !== isView;
}

async function listMissions(form, robot) {
  const found = await ask(`/api/v1/robots/${encodeURIComponent(robot)}/missions?limit=${MISSIONS}`).catch(() => []);
  const lines = found.map((mission) => el("label", { class: "field check" },
    el("input", { type: "checkbox", name: "missions", value: mission.id, "data-type": "list" }),
    el("span", {}, mission.name, " ", el("span", { class: "muted small" }, local(Date.parse(mission.from)), mission.outcome ? ` · ${mission.outcome}` : ""))));
  one("[data-missions]", form).replaceChildren(...(lines.length ? lines : [el("p", { class: "muted" }, t("data.goto.none"))]));
}
