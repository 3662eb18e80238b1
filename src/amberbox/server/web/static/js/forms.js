// Forms, buttons and dialogs that call the API.
//
// A form or button with `data-post` sends to that path: `data-method` is the method (POST),
// `data-body` more of what is sent, `data-confirm` a question asked before, `data-done` what
// follows: `reload`, `goto:/path`, `toast:text`, `show:field` (a secret of the answer, shown once
// with `data-note`), or `event` for nothing more. The element dispatches `done` or `refused`.

import { clearError, requestJson, toast, whileBusy } from "./api.js";
import { el, find, findAll, icon } from "./dom.js";
import { t } from "./strings.js";
import { fieldToStamp } from "./time.js";

const READERS = {
  int: (text) => (text === "" ? null : Number.parseInt(text, 10)),
  float: (text) => (text === "" ? null : Number.parseFloat(text)),
  list: (text) => text.split(/[\s,]+/).filter(Boolean),
  json: (text) => JSON.parse(text),
  time: fieldToStamp,
  text: (text) => text,
};

/** Listen to all such forms and buttons of the page, also those that come later. */
export function startForms() {
  linkEveryBoxes();
  linkRepeatedFields();
  document.addEventListener("submit", (event) => {
    if (!event.target.matches("form[data-post]")) return;
    event.preventDefault();
    submit(event.target, () => formValues(event.target), event.submitter);
  });
  document.addEventListener("click", (event) => {
    const button = event.target.closest("button[data-post]");
    if (button) submit(button, () => ({}), button);
  });
}

/** A box `data-type="every"` stands for all boxes of its name; without it one of them is required. */
function linkEveryBoxes() {
  for (const everyBox of findAll('[data-type="every"]')) {
    const others = [...everyBox.form.elements].filter((box) => box.name === everyBox.name && box !== everyBox);
    const update = () => {
      for (const box of others) box.disabled = everyBox.checked;
      const isChosen = everyBox.checked || others.some((box) => box.checked);
      everyBox.setCustomValidity(isChosen ? "" : everyBox.dataset.choose);
    };
    for (const box of [everyBox, ...others]) box.addEventListener("change", update);
    update();
  }
}

/** A field `data-again="NAME"` is valid only while it repeats the field of that name. */
function linkRepeatedFields() {
  for (const repeated of findAll("input[data-again]")) {
    const first = repeated.form.elements[repeated.dataset.again];
    const compare = () => repeated.setCustomValidity(first.value === repeated.value ? "" : repeated.dataset.differ);
    first.addEventListener("input", compare);
    repeated.addEventListener("input", compare);
  }
}

/**
 * Start a dialog with a form, opened by buttons `data-open="ID"`, closed by Escape and `data-close`.
 * `opened` fills it; `send` gets the values of its fields, and may throw ApiError.
 * @param {string} id
 * @param {{opened?: function(HTMLFormElement): void, send: function(any): Promise<void>}} options
 */
export function dialogForm(id, { opened = () => {}, send }) {
  const dialog = document.getElementById(id);
  if (!dialog) return; // the viewer has no permission
  const form = find("form", dialog);
  for (const button of findAll(`[data-open="${id}"]`)) {
    button.addEventListener("click", () => {
      clearError(form);
      opened(form);
      dialog.showModal();
    });
  }
  for (const button of findAll("[data-close]", dialog)) button.addEventListener("click", () => dialog.close());
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    whileBusy(form, event.submitter, async () => {
      await send(formValues(form));
      dialog.close();
    });
  });
}

/** Return the values of a form by the names of its fields. @param {HTMLFormElement} form */
function formValues(form) {
  const values = {};
  for (const input of form.elements) {
    if (input.name && !input.disabled) readInput(values, input);
  }
  return values;
}

function readInput(values, input) {
  const as = input.dataset.type ?? "text";
  if (as === "every") {
    if (input.checked) values[input.name] = null;
  } else if (input.type === "checkbox" && as === "list") {
    values[input.name] = [...(values[input.name] ?? []), ...(input.checked ? [input.value] : [])];
  } else if (input.type === "checkbox") {
    values[input.name] = input.checked;
  } else if (input.type !== "radio" || input.checked) {
    const value = input.multiple ? [...input.selectedOptions].map((option) => option.value) : READERS[as](input.value);
    if (!(input.value === "" && "leaveOut" in input.dataset)) values[input.name] = value;
  }
}

async function submit(element, read, button) {
  const place = element.tagName === "FORM" ? element : element.closest("[data-errors]");
  const { confirm, body: fixed = "{}", method = "POST", post } = element.dataset;
  if (confirm && !(await askConfirmation(confirm))) return;
  const error = await whileBusy(place, button, async () => {
    const body = { ...JSON.parse(fixed), ...read() };
    const hasBody = method !== "DELETE" || Object.keys(body).length > 0;
    await afterSubmit(element, await requestJson(post, { method, body: hasBody ? body : undefined }));
  });
  if (error) element.dispatchEvent(new CustomEvent("refused", { bubbles: true, detail: error }));
}

async function afterSubmit(element, answer) {
  const [action, ...rest] = (element.dataset.done ?? "reload").split(":");
  const argument = rest.join(":");
  element.dispatchEvent(new CustomEvent("done", { bubbles: true, detail: answer }));
  if (action === "show") await showSecret(answer[argument], element.dataset.note);
  if (action === "reload" || action === "show") location.reload();
  else if (action === "goto") goTo(argument);
  else if (action === "toast") toast(argument || t("common.done"));
}

/** Go to a page of this server, never to another. @param {string} address */
function goTo(address) {
  const to = new URL(address, location.href);
  location.assign(to.origin === location.origin ? to : "/");
}

/** Ask a question in a dialog; true for yes. @param {string} question @returns {Promise<boolean>} */
async function askConfirmation(question) {
  const button = (value, text, kind) => el("button", { class: `button ${kind}`, value }, text);
  const buttons = [button("yes", t("common.yes"), "primary"), button("no", t("common.cancel"), "")];
  return (await showDialog(question, [], buttons)) === "yes";
}

/** Show a secret that cannot be had again; resolves when it was put away. @param {string} note what to do with it */
async function showSecret(text, note) {
  const field = el("textarea", { readonly: true, rows: 4, class: "mono once", "aria-label": note, spellcheck: "false" });
  field.value = text;
  const copy = el("button", { class: "button primary", type: "button", onclick: () => copyText(field) }, icon("check"), t("common.copy"));
  const closed = showDialog(note, [field], [copy, el("button", { class: "button", value: "away" }, t("common.put_away"))]);
  field.select();
  await closed;
}

/** Show a dialog of a text, more elements and buttons; resolves to the value of the pressed one. */
function showDialog(text, more, buttons) {
  const form = el("form", { method: "dialog", class: "stack" }, el("p", {}, text), ...more, el("div", { class: "row" }, ...buttons));
  const dialog = el("dialog", { "aria-label": text }, form);
  document.body.append(dialog);
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(dialog.returnValue);
    });
  });
}

/** Copy the text of a field, which stays selected where the browser forbids that. */
async function copyText(field) {
  field.select();
  try {
    await navigator.clipboard.writeText(field.value);
  } catch {
    document.execCommand("copy");
  }
  toast(t("common.copied"));
}
