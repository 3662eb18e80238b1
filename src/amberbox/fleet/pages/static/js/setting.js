// A setting: its form, and what comes of it.

import { ask, clear, fail, toast } from "./ask.js";
import { all, brought, el, one } from "./dom.js";
import { editor } from "./schemaform.js";
import { t } from "./strings.js";

const setting = brought("setting");
const form = one("#setting-form");
const made = editor(setting.form, setting.value);

async function save(event) {
  event.preventDefault();
  clear(form);
  try {
    await ask(`/api/v1/settings/${setting.name}`, { method: "PUT", body: made.read() });
    toast(t("setting.saved"));
    if (one("[data-destinations]")) location.reload();
  } catch (error) {
    fail(error, form);
  }
}

async function tryOut(button) {
  button.setAttribute("aria-busy", "true");
  const body = { destination: button.dataset.test };
  const near = button.closest("li");
  clear(near);
  try {
    const { arrived, trouble } = await ask("/api/v1/settings/notifications/test", { method: "POST", body });
    if (arrived) toast(t("setting.arrived"));
    else fail({ message: t("setting.not_arrived"), hint: trouble }, near);
  } catch (error) {
    fail(error, near);
  } finally {
    button.removeAttribute("aria-busy");
  }
}

form.prepend(el("div", { class: "stack" }, made.node));
form.addEventListener("submit", save);
for (const button of all("[data-test]")) button.addEventListener("click", () => tryOut(button));
