// A setting: its form, and what comes of it.

import { ask, clear, fail, toast } from "./ask.js";
import { all, brought, el, one, setText } from "./dom.js";
import { editor } from "./schemaform.js";
import { t } from "./strings.js";
import { local, nowMs } from "./time.js";

const setting = brought("setting");
const form = one("#setting-form");
const made = editor(setting.form, setting.value);

async function save(event) {
  event.preventDefault();
  clear(form);
  try {
    await ask(`/api/v1/settings/${setting.name}`, { method: "PUT", body: made.read() });
    toast(t("setting.saved"));
    if (one("#destinations")) location.reload();
  } catch (error) {
    fail(error, form);
  }
}

/** Send a test to a destination, and say beside it what became of that. */
async function tryOut(button) {
  const place = button.closest("li");
  const said = one("[data-answer]", place);
  clear(place);
  setText(said, t("setting.sending"));
  button.disabled = true;
  try {
    const body = { destination: button.dataset.test };
    const { arrived, trouble } = await ask("/api/v1/settings/notifications/test", { method: "POST", body });
    setText(said, arrived ? t("setting.arrived", { at: local(nowMs(), "time") }) : "");
    if (!arrived) fail({ message: t("setting.not_arrived"), hint: trouble }, place);
  } catch (error) {
    setText(said, "");
    fail(error, place);
  } finally {
    button.disabled = false;
  }
}

form.prepend(el("div", { class: "stack" }, made.node));
form.addEventListener("submit", save);
for (const button of all("[data-test]")) button.addEventListener("click", () => tryOut(button));
