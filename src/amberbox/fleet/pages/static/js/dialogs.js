/** Dialogs with a form: opened by buttons `data-open="ID"`, closed by Escape and `data-close`. */

import { clear, fail } from "./ask.js";
import { all, one } from "./dom.js";
import { fields } from "./forms.js";

/**
 * Make a dialog work. `opened` fills it; `send` gets what its fields hold, and may throw AskError.
 * @param {string} id
 * @param {{opened?: function(HTMLFormElement): void, send: function(any): Promise<void>}} about
 */
export function dialogForm(id, { opened = () => {}, send }) {
  const dialog = document.getElementById(id);
  if (!dialog) return; // not for who may not
  const form = one("form", dialog);
  for (const button of all(`[data-open="${id}"]`)) {
    button.addEventListener("click", () => {
      clear(form);
      opened(form);
      dialog.showModal();
    });
  }
  for (const button of all("[data-close]", dialog)) button.addEventListener("click", () => dialog.close());
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const button = event.submitter;
    clear(form);
    button?.setAttribute("aria-busy", "true");
    try {
      await send(fields(form));
      dialog.close();
    } catch (error) {
      fail(error, form);
    } finally {
      button?.removeAttribute("aria-busy");
    }
  });
}
