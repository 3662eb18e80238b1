// What is shown once: a line to join, a password, a token. It is never fetched again.

import { toast } from "./ask.js";
import { el, icon } from "./dom.js";
import { t } from "./strings.js";

/**
 * Show a text that will not be shown again; resolves when it was put away.
 * @param {string} text
 * @param {string} note what to do with it
 */
export function showOnce(text, note) {
  const field = el("textarea", { readonly: true, rows: 4, class: "mono once", "aria-label": note, spellcheck: "false" });
  field.value = text;
  const copy = el("button", { class: "button primary", type: "button", onclick: () => take(field) }, icon("check"), t("common.copy"));
  const away = el("button", { class: "button", value: "away" }, t("common.put_away"));
  const form = el("form", { method: "dialog", class: "stack" }, el("p", {}, note), field, el("div", { class: "row" }, copy, away));
  const dialog = el("dialog", { "aria-label": note }, form);
  document.body.append(dialog);
  dialog.showModal();
  field.select();
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve();
    });
  });
}

/** Copy a field's text: where the browser forbids it, the text is selected for the keyboard. */
async function take(field) {
  field.select();
  try {
    await navigator.clipboard.writeText(field.value);
  } catch {
    document.execCommand("copy");
  }
  toast(t("common.copied"));
}
