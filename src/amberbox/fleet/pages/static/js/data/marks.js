/** Marking: the window as an incident that is kept, or a moment by a note. */

import { ask, toast } from "../ask.js";
import { el, one, setText } from "../dom.js";
import { dialogForm } from "../dialogs.js";
import { spanOf } from "./goto.js";
import { moment } from "../plot/time.js";
import { t } from "../strings.js";
import { stamp } from "../timewords.js";

/**
 * Make the two dialogs work. @param {string} robot
 * @param {{window: function(): {from: number, to: number}, cursor: function(): ?number,
 *   changed: function(): void}} about
 */
export function marks(robot, { window, cursor, changed }) {
  const path = `/api/v1/robots/${encodeURIComponent(robot)}`;
  const noted = { at: 0 };

  dialogForm("mark", {
    opened(form) {
      const { from, to } = window();
      setText(one("[data-span]", form), t("data.span", { from: moment(from, 1), to: moment(to, 1) }));
    },
    async send({ reason }) {
      const { from, to } = window();
      await ask(`${path}/incidents`, { method: "POST", body: { reason, from: stamp(from), to: stamp(to) } });
      toast(t("data.mark.done"));
      changed();
    },
  });

  dialogForm("note", {
    async opened(form) {
      const { from, to } = window();
      noted.at = cursor() ?? (from + to) / 2;
      setText(one("[data-at]", form), moment(noted.at, 0.1));
      await missionsAt(form, path, noted.at);
    },
    async send({ text, mission }) {
      const place = mission ? `${path}/missions/${encodeURIComponent(mission)}` : path;
      await ask(`${place}/notes`, { method: "POST", body: { text, at: stamp(noted.at) } });
      toast(t("data.note.done"));
      changed();
    },
  });
}

/** Offer the missions that were under way at a moment, where there were any. */
async function missionsAt(form, path, at) {
  const send = one('button[type="submit"]', form);
  send.disabled = true;
  const query = new URLSearchParams({ from: stamp(at - 1), to: stamp(at + 1) });
  const found = await ask(`${path}/missions?${query}`).catch(() => []);
  const fitting = found.filter((mission) => {
    const [from, to] = spanOf(mission);
    return from <= at && at <= to;
  });
  const named = fitting.map((mission) => el("option", { value: mission.id }, `${mission.name} · ${mission.id}`));
  form.elements.mission.replaceChildren(...named, el("option", { value: "" }, t("data.note.no_mission")));
  one("[data-some]", form).hidden = !fitting.length;
  send.disabled = false;
}
