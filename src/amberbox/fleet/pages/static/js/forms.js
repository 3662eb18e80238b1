// Forms and buttons that ask the API: `data-post` is the path, `data-method` the method (POST),
// `data-body` more of what is sent, `data-confirm` what is asked before, `data-done` what comes
// after: `reload`, `goto:/path`, `toast:text`, `show:field` (of the answer, once, with `data-note`),
// or `event`, which is told as `done` on the element.

import { ask, clear, fail, toast } from "./ask.js";
import { el } from "./dom.js";
import { showOnce } from "./once.js";
import { t } from "./strings.js";
import { fieldStamp } from "./time.js";

const READ = {
  int: (text) => (text === "" ? null : Number.parseInt(text, 10)),
  float: (text) => (text === "" ? null : Number.parseFloat(text)),
  list: (text) => text.split(/[\s,]+/).filter(Boolean),
  json: (text) => JSON.parse(text),
  time: fieldStamp,
  text: (text) => text,
};

/** Listen to all such forms and buttons of the page, also those that come later. */
export function start() {
  document.addEventListener("submit", (event) => {
    if (!event.target.matches("form[data-post]")) return;
    event.preventDefault();
    send(event.target, () => fields(event.target), event.submitter);
  });
  document.addEventListener("click", (event) => {
    const button = event.target.closest("button[data-post]");
    if (button) send(button, () => ({}), button);
  });
}

/** Return what a form's fields hold, by their names. @param {HTMLFormElement} form */
export function fields(form) {
  const found = {};
  for (const input of form.elements) {
    if (input.name && !input.disabled) put(found, input);
  }
  return found;
}

function put(found, input) {
  const as = input.dataset.type ?? "text";
  if (as === "every") {
    if (input.checked) found[input.name] = null;
  } else if (input.type === "checkbox" && as === "list") {
    found[input.name] = [...(found[input.name] ?? []), ...(input.checked ? [input.value] : [])];
  } else if (input.type === "checkbox") {
    found[input.name] = input.checked;
  } else if (input.type !== "radio" || input.checked) {
    const value = input.multiple ? [...input.selectedOptions].map((one) => one.value) : READ[as](input.value);
    if (!(input.value === "" && "leaveOut" in input.dataset)) found[input.name] = value;
  }
}

async function send(element, read, button) {
  const near = element.tagName === "FORM" ? element : element.closest("[data-errors]");
  const about = element.dataset;
  if (about.confirm && !(await confirmed(about.confirm))) return;
  clear(near);
  button?.setAttribute("aria-busy", "true");
  try {
    const body = { ...JSON.parse(about.body ?? "{}"), ...read() };
    const method = about.method ?? "POST";
    const has = method !== "DELETE" || Object.keys(body).length > 0;
    await after(element, await ask(about.post, { method, body: has ? body : undefined }));
  } catch (error) {
    fail(error, near);
    element.dispatchEvent(new CustomEvent("refused", { bubbles: true, detail: error }));
  } finally {
    button?.removeAttribute("aria-busy");
  }
}

async function after(element, answer) {
  const [what, ...rest] = (element.dataset.done ?? "reload").split(":");
  const more = rest.join(":");
  element.dispatchEvent(new CustomEvent("done", { bubbles: true, detail: answer }));
  if (what === "show") await showOnce(answer[more], element.dataset.note);
  if (what === "reload" || what === "show") location.reload();
  else if (what === "goto") go(more);
  else if (what === "toast") toast(more || t("common.done"));
}

/** Go to a page of this server; nowhere else. @param {string} address */
function go(address) {
  const to = new URL(address, location.href);
  location.assign(to.origin === location.origin ? to : "/");
}

/** Ask a person; true for yes. @param {string} question @returns {Promise<boolean>} */
export function confirmed(question) {
  const dialog = el("dialog", { "aria-label": question });
  const button = (value, text, kind) => el("button", { class: `button ${kind}`, value }, text);
  const buttons = el("div", { class: "row" }, button("yes", t("common.yes"), "primary"), button("no", t("common.cancel"), ""));
  dialog.append(el("form", { method: "dialog", class: "stack" }, el("p", {}, question), buttons));
  document.body.append(dialog);
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(dialog.returnValue === "yes");
    });
  });
}
