// A form for a value that a JSON schema describes: settings are edited as what they are.
// An editor has `node`, which is shown, and `read()`, which returns the value as it stands there.

import { el, icon } from "./dom.js";
import { has, t } from "./strings.js";

const UNITS = [["s", 1], ["min", 60], ["h", 3600], ["d", 86400]];
const SECRET = /password|secret|token/;

/**
 * Make an editor.
 * @param {any} schema @param {any} value @param {string} [name] of the field, which names its label
 * @returns {{node: HTMLElement, read: () => any}}
 */
export function editor(schema, value, name = "", defs = schema.$defs ?? {}) {
  const form = resolved(schema, defs);
  const make = kind(form, name);
  return make(form, value === undefined ? form.default : value, name, defs);
}

function kind(form, name) {
  if (form.enum) return choice;
  if (form.anyOf) return form.anyOf.some((one) => one.type === "null") ? optional : anything;
  if (form.type === "object") return form.properties ? fieldset : pairs;
  if (form.type === "array" && form.items.enum) return several;
  if (form.type === "array") return form.items.type === "string" ? words : list;
  if (form.type === "boolean") return check;
  if (form.type === "number" || form.type === "integer") return name.endsWith("_s") ? duration : number;
  return text;
}

function resolved(schema, defs) {
  if (!schema.$ref) return schema;
  const { $ref, ...more } = schema;
  return { ...defs[$ref.split("/").pop()], ...more };
}

const label = (name) => (has(`setting.field.${name}`) ? t(`setting.field.${name}`) : name.replaceAll("_", " "));
const note = (name) => (has(`setting.note.${name}`) ? el("small", { class: "note" }, t(`setting.note.${name}`)) : null);
const field = (name, ...inside) => el("label", { class: "field" }, el("span", {}, label(name)), ...inside, note(name));

function text(_, value, name) {
  const input = el("input", { type: SECRET.test(name) ? "password" : "text", value: value ?? "", maxlength: 1000, autocomplete: "off", spellcheck: "false" });
  const kept = SECRET.test(name) && value ? el("small", { class: "note" }, t("setting.kept")) : null;
  return { node: field(name, input, kept), read: () => input.value };
}

function number(form, value, name) {
  const input = el("input", { type: "number", step: form.type === "integer" ? 1 : "any", value: value ?? "", required: true });
  return { node: field(name, input), read: () => Number(input.value) };
}

function duration(_, value, name) {
  const seconds = value ?? 0;
  const [unit, size] = UNITS.findLast(([, size]) => seconds >= size && seconds % size === 0) ?? UNITS[0];
  const input = el("input", { type: "number", step: "any", min: 0, value: seconds / size, required: true, "aria-label": label(name) });
  const options = UNITS.map(([one]) => el("option", { value: one, selected: one === unit }, t(`setting.unit.${one}`)));
  const select = el("select", { "aria-label": t("setting.unit_of", { name: label(name) }) }, ...options);
  const node = el("div", { class: "field" }, el("span", {}, label(name)), el("div", { class: "duration" }, input, select), note(name));
  return { node, read: () => Number(input.value) * Object.fromEntries(UNITS)[select.value] };
}

function check(_, value, name) {
  const input = el("input", { type: "checkbox", checked: value === true });
  return { node: el("label", { class: "field check" }, input, el("span", {}, label(name))), read: () => input.checked };
}

const word = (one) => (has(`setting.choice.${one}`) ? t(`setting.choice.${one}`) : one);

function choice(form, value, name) {
  const order = form.enum.includes("urgent") ? ["warning", "urgent", "critical", "fatal"] : form.enum;
  const select = el("select", {}, ...order.map((one) => el("option", { value: one, selected: one === value }, word(one))));
  return { node: field(name, select), read: () => select.value };
}

/** Any of a few words, each with a box to tick. */
function several(form, value, name) {
  const boxes = form.items.enum.map((one) => [one, el("input", { type: "checkbox", checked: (value ?? []).includes(one) })]);
  const lines = boxes.map(([one, box]) => el("label", { class: "field check" }, box, el("span", {}, word(one))));
  const node = el("fieldset", { class: "fields" }, el("legend", {}, label(name)), ...lines, note(name));
  return { node, read: () => boxes.filter(([, box]) => box.checked).map(([one]) => one) };
}

function words(_, value, name) {
  const input = el("input", { type: "text", value: (value ?? []).join(" "), autocomplete: "off", spellcheck: "false" });
  return { node: field(name, input), read: () => input.value.split(/[\s,]+/).filter(Boolean) };
}

/** A value that is a truth, a number, or a text: as JSON has it, else it is the text. */
function anything(_, value, name) {
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

function optional(form, value, name, defs) {
  const inner = form.anyOf.find((one) => one.type !== "null");
  const made = editor(inner, value ?? undefined, name, defs);
  const box = el("input", { type: "checkbox", checked: value !== null && value !== undefined });
  const inside = el("div", {}, made.node);
  const show = () => {
    inside.hidden = !box.checked;
    for (const one of inside.querySelectorAll("input, select")) one.disabled = !box.checked;
  };
  box.addEventListener("change", show);
  show();
  const word = has(`setting.optional.${name}`) ? t(`setting.optional.${name}`) : label(name);
  const node = el("div", { class: "stack tight" }, el("label", { class: "field check" }, box, el("span", {}, word)), inside);
  return { node, read: () => (box.checked ? made.read() : null) };
}

function fieldset(form, value, name, defs) {
  const made = Object.entries(form.properties).map(([key, one]) => [key, editor(one, value?.[key], key, defs)]);
  const legend = name ? el("legend", {}, label(name)) : null;
  const node = el(name ? "fieldset" : "div", { class: "fields" }, legend, ...made.map(([, one]) => one.node));
  return { node, read: () => Object.fromEntries(made.map(([key, one]) => [key, one.read()])) };
}

function list(form, value, name, defs) {
  const rows = new Map();
  const body = el("div", { class: "stack tight" });
  const add = (one) => {
    const made = editor(form.items, one, "", defs);
    const row = el("div", { class: "entry" }, made.node, remover(() => rows.delete(row)));
    rows.set(row, made);
    body.append(row);
  };
  (value ?? []).forEach(add);
  const more = el("button", { class: "button small", type: "button", onclick: () => add(undefined) }, icon("plus"), t("setting.add"));
  const node = el("fieldset", { class: "stack tight" }, el("legend", {}, name ? label(name) : t("setting.rules")), body, el("div", {}, more));
  return { node, read: () => [...rows.values()].map((one) => one.read()) };
}

function pairs(form, value, name, defs) {
  const items = { type: "object", properties: { key: { type: "string" }, value: form.additionalProperties } };
  const made = list({ items }, Object.entries(value ?? {}).map(([key, one]) => ({ key, value: one })), name, defs);
  return { node: made.node, read: () => Object.fromEntries(made.read().map((one) => [one.key, one.value])) };
}

function remover(removed) {
  const button = el("button", { class: "button small quiet", type: "button", "aria-label": t("setting.remove"), title: t("setting.remove") }, icon("trash"));
  button.addEventListener("click", () => {
    removed();
    button.parentElement.remove();
  });
  return button;
}
