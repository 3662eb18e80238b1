// What people do on the page of a robot, in dialogs: mark an incident, begin and end missions.

import { all, one } from "../dom.js";

/**
 * Open the dialogs that buttons of the page name; `done` is called when something was done in one.
 * @param {HTMLElement} page
 * @param {() => void} done
 */
export function startActs(page, done) {
  page.addEventListener("click", (event) => {
    const button = event.target.closest("button[data-act]");
    if (button) open(button.dataset);
  });
  for (const dialog of all("dialog")) {
    one("[data-close]", dialog)?.addEventListener("click", () => dialog.close());
    dialog.addEventListener("done", () => {
      dialog.close();
      done();
    });
  }
}

/** Open a dialog, empty; `path` is where its form is sent. */
function open({ act: name, path }) {
  const dialog = one(`#dialog-${name}`);
  const form = one("form", dialog);
  if (path) form.dataset.post = path;
  form.reset();
  dialog.showModal();
}
