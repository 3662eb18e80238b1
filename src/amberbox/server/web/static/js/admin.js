// Pages of administration: settings as forms of their JSON schema, and the check of the audit log.

import { clearError, requestJson, showError, toast, whileBusy } from "./api.js";
import { el, find, findAll, icon, levelBadge, pageData, setText } from "./dom.js";
import { hasText, t } from "./strings.js";
import { localTime, nowMs } from "./time.js";

const UNITS = [["s", 1], ["min", 60], ["h", 3600], ["d", 86400]];
const SECRET = /password|secret|token/;

/**
 * Make the editor of a value with a JSON schema: `node` is shown, `read()` returns the edited value.
 * @param {any} schema @param {any} value @param {string} [name] of the field, for its label
 * @returns {{node: HTMLElement, read: () => any}}
 */
function editor(schema, value, name = "", defs = schema.$defs ?? {}) {
  const shape = resolveReference(schema, defs);
  const make = editorFor(shape, name);
  return make(shape, value === undefined ? shape.default : value, name, defs);
}

function editorFor(shape, name) {
  if (shape.enum) return choiceEditor;
  if (shape.anyOf) return shape.anyOf.some((item) => item.type === "null") ? optionalEditor : anyValueEditor;
  if (shape.type === "object") return shape.properties ? objectEditor : mapEditor;
  if (shape.type === "array" && shape.items.enum) return multipleChoiceEditor;
  if (shape.type === "array") return shape.items.type === "string" ? stringListEditor : listEditor;
  if (shape.type === "boolean") return booleanEditor;
  if (shape.type === "number" || shape.type === "integer") return name.endsWith("_s") ? durationEditor : numberEditor;
  return textEditor;
}

function resolveReference(schema, defs) {
  if (!schema.$ref) return schema;
  const { $ref, ...more } = schema;
  return { ...defs[$ref.split("/").pop()], ...more };
}

const label = (name) => (hasText(`setting.field.${name}`) ? t(`setting.field.${name}`) : name.replaceAll("_", " "));
const note = (name) => (hasText(`setting.note.${name}`) ? el("small", { class: "note" }, t(`setting.note.${name}`)) : null);
const field = (name, ...inside) => el("label", { class: "field" }, el("span", {}, label(name)), ...inside, note(name));

function textEditor(_, value, name) {
  const input = el("input", { type: SECRET.test(name) ? "password" : "text", value: value ?? "", maxlength: 1000, autocomplete: "off", spellcheck: "false" });
  const keptNote = SECRET.test(name) && value ? el("small", { class: "note" }, t("setting.kept")) : null;
  return { node: field(name, input, keptNote), read: () => input.value };
}

function numberEditor(shape, value, name) {
  const input = el("input", { type: "number", step: shape.type === "integer" ? 1 : "any", value: value ?? "", required: true });
  return { node: field(name, input), read: () => Number(input.value) };
}

function durationEditor(_, value, name) {
  const seconds = value ?? 0;
  const [unit, size] = UNITS.findLast(([, size]) => seconds >= size && seconds % size === 0) ?? UNITS[0];
  const input = el("input", { type: "number", step: "any", min: 0, value: seconds / size, required: true, "aria-label": label(name) });
  const options = UNITS.map(([item]) => el("option", { value: item, selected: item === unit }, t(`setting.unit.${item}`)));
  const select = el("select", { "aria-label": t("setting.unit_of", { name: label(name) }) }, ...options);
  const node = el("div", { class: "field" }, el("span", {}, label(name)), el("div", { class: "duration" }, input, select), note(name));
  return { node, read: () => Number(input.value) * Object.fromEntries(UNITS)[select.value] };
}

function booleanEditor(_, value, name) {
  const input = el("input", { type: "checkbox", checked: value === true });
  return { node: el("label", { class: "field check" }, input, el("span", {}, label(name))), read: () => input.checked };
}

const choiceText = (item) => (hasText(`setting.choice.${item}`) ? t(`setting.choice.${item}`) : item);

function choiceEditor(shape, value, name) {
  const order = shape.enum.includes("urgent") ? ["warning", "urgent", "critical", "fatal"] : shape.enum;
  const select = el("select", {}, ...order.map((item) => el("option", { value: item, selected: item === value }, choiceText(item))));
  return { node: field(name, select), read: () => select.value };
}

/** Edit any of several words, each with a box. */
function multipleChoiceEditor(shape, value, name) {
  const boxes = shape.items.enum.map((item) => [item, el("input", { type: "checkbox", checked: (value ?? []).includes(item) })]);
  const lines = boxes.map(([item, box]) => el("label", { class: "field check" }, box, el("span", {}, choiceText(item))));
  const node = el("fieldset", { class: "fields" }, el("legend", {}, label(name)), ...lines, note(name));
  return { node, read: () => boxes.filter(([, box]) => box.checked).map(([item]) => item) };
}

function stringListEditor(_, value, name) {
  const input = el("input", { type: "text", value: (value ?? []).join(" "), autocomplete: "off", spellcheck: "false" });
  return { node: field(name, input), read: () => input.value.split(/[\s,]+/).filter(Boolean) };
}

/** Edit a value of any type: what is no JSON is a text. */
function anyValueEditor(_, value, name) {
  const input = el("input", { type: "text", value: typeof value === "string" ? value : JSON.stringify(value ?? "") });
  const read = () => {
    try {
      return JSON.parse(input.value);
    } catch {
      return input.value;
    }
  };
  return { node: field(name, input), read };
}

function optionalEditor(shape, value, name, defs) {
  const inner = shape.anyOf.find((item) => item.type !== "null");
  const nested = editor(inner, value ?? undefined, name, defs);
  const box = el("input", { type: "checkbox", checked: value !== null && value !== undefined });
  const inside = el("div", {}, nested.node);
  const show = () => {
    inside.hidden = !box.checked;
    for (const item of inside.querySelectorAll("input, select")) item.disabled = !box.checked;
  };
  box.addEventListener("change", show);
  show();
  const labelText = hasText(`setting.optional.${name}`) ? t(`setting.optional.${name}`) : label(name);
  const node = el("div", { class: "stack tight" }, el("label", { class: "field check" }, box, el("span", {}, labelText)), inside);
  return { node, read: () => (box.checked ? nested.read() : null) };
}

function objectEditor(shape, value, name, defs) {
  const nested = Object.entries(shape.properties).map(([key, item]) => [key, editor(item, value?.[key], key, defs)]);
  const legend = name ? el("legend", {}, label(name)) : null;
  const node = el(name ? "fieldset" : "div", { class: "fields" }, legend, ...nested.map(([, item]) => item.node));
  return { node, read: () => Object.fromEntries(nested.map(([key, item]) => [key, item.read()])) };
}

function listEditor(shape, value, name, defs) {
  const rows = new Map();
  const body = el("div", { class: "stack tight" });
  const add = (item) => {
    const nested = editor(shape.items, item, "", defs);
    const row = el("div", { class: "entry" }, nested.node, removeButton(() => rows.delete(row)));
    rows.set(row, nested);
    body.append(row);
  };
  (value ?? []).forEach(add);
  const more = el("button", { class: "button small", type: "button", onclick: () => add(undefined) }, icon("plus"), t("setting.add"));
  const node = el("fieldset", { class: "stack tight" }, el("legend", {}, name ? label(name) : t("setting.rules")), body, el("div", {}, more));
  return { node, read: () => [...rows.values()].map((item) => item.read()) };
}

function mapEditor(shape, value, name, defs) {
  const items = { type: "object", properties: { key: { type: "string" }, value: shape.additionalProperties } };
  const nested = listEditor({ items }, Object.entries(value ?? {}).map(([key, item]) => ({ key, value: item })), name, defs);
  return { node: nested.node, read: () => Object.fromEntries(nested.read().map((item) => [item.key, item.value])) };
}

function removeButton(removed) {
  const button = el("button", { class: "button small quiet", type: "button", "aria-label": t("setting.remove"), title: t("setting.remove") }, icon("trash"));
  button.addEventListener("click", () => {
    removed();
    button.parentElement.remove();
  });
  return button;
}

async function saveSetting(form, name, read) {
  clearError(form);
  try {
    await requestJson(`/api/v1/settings/${name}`, { method: "PUT", body: read() });
    toast(t("setting.saved"));
    if (find("#destinations")) location.reload();
  } catch (error) {
    showError(error, form);
  }
}

/** Send a test to a destination, and show the result beside it. */
async function sendTest(button) {
  const place = button.closest("li");
  const answer = find("[data-answer]", place);
  clearError(place);
  setText(answer, t("setting.sending"));
  button.disabled = true;
  try {
    const body = { destination: button.dataset.test };
    const { arrived, trouble } = await requestJson("/api/v1/settings/notifications/test", { method: "POST", body });
    setText(answer, arrived ? t("setting.arrived", { at: localTime(nowMs(), "time") }) : "");
    if (!arrived) showError({ message: t("setting.not_arrived"), hint: trouble }, place);
  } catch (error) {
    setText(answer, "");
    showError(error, place);
  } finally {
    button.disabled = false;
  }
}

/** Show the setting of the page. @param {HTMLFormElement} form */
function startSetting(form) {
  const setting = pageData("setting");
  const { node, read } = editor(setting.form, setting.value);
  form.prepend(el("div", { class: "stack" }, node));
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    saveSetting(form, setting.name, read);
  });
  for (const button of findAll("[data-test]")) button.addEventListener("click", () => sendTest(button));
}

/** Verify the hash chain of the audit log, and show the verdict. */
async function verifyAuditLog() {
  const { holds, rows, broken, what } = await requestJson("/api/v1/audit/verify");
  const text = holds ? t("audit.holds", { n: rows }) : t("audit.broken", { n: broken, what });
  find("#verdict").replaceChildren(levelBadge(holds ? "ok" : "error", text));
}

const settingForm = find("#setting-form");
if (settingForm) startSetting(settingForm);
const verifyButton = find("#verify");
verifyButton?.addEventListener("click", () => whileBusy(verifyButton.parentElement, verifyButton, verifyAuditLog));
