// The forms about an alarm while it changes: what one writes stays, and so does what one saw.

import { all, one } from "../dom.js";
import { fieldStamp, refresh, rfc3339 } from "../time.js";

const MORNING_H = 7;

/** Give the choices of times their values, and show the field of one's own only when it counts. */
export function start(act) {
  const shelve = one("#shelve", act);
  if (!shelve) return;
  shelve.addEventListener("change", () => fill(shelve));
  shelve.addEventListener("input", () => fill(shelve));
  fill(shelve);
}

function fill(shelve) {
  const own = one("[data-own-time]", shelve);
  const radio = one('[data-until="own"]', shelve);
  one('[data-until="tomorrow"]', shelve).value = rfc3339(tomorrow());
  if (own.value) radio.value = fieldStamp(own.value);
  own.hidden = !radio.checked;
  own.required = radio.checked;
}

function tomorrow() {
  const at = new Date();
  at.setDate(at.getDate() + 1);
  at.setHours(MORNING_H, 0, 0, 0);
  return at;
}

/**
 * Return the fresh part with what stood in the forms of the old one; not of `mine`, which was sent.
 * A form that somebody writes in keeps the revision that they saw: if another one counts by now,
 * the server says so.
 */
export function carried(old, fresh, mine) {
  for (const form of all("form[id]", old)) {
    const now = one(`#${form.id}`, fresh);
    if (!now || form === mine) continue;
    const isUsed = copy(form, now);
    if (isUsed && !("seen" in form.dataset)) now.dataset.body = form.dataset.body;
    for (const said of all(":scope > [data-failed]", form)) now.append(said);
  }
  for (const details of all("details[open]", old)) {
    if (!details.contains(mine)) one(`#${details.id}`, fresh)?.setAttribute("open", "");
  }
  return fresh;
}

/** Say that one is shown what is new: the form takes the new revision along. */
export function forget(element) {
  const form = element.closest("form");
  if (form) form.dataset.seen = "";
}

/** Put the fresh part in place; the focus stays where it was. */
export function place(old, fresh) {
  const held = old.contains(document.activeElement) ? handle(document.activeElement) : null;
  refresh(fresh);
  old.replaceWith(fresh);
  start(fresh);
  if (held) (one(held, fresh) ?? one("#alarm-act-title")).focus({ preventScroll: true });
}

function handle(element) {
  const form = element.closest("form[id]");
  const own = element.name ? `[name="${element.name}"]` : element.tagName.toLowerCase();
  if (form) return `#${form.id} ${own}${element.type === "radio" ? ":checked" : ""}`;
  const details = element.closest("details[id]");
  return details ? `#${details.id} > summary` : "summary, button";
}

/** Copy what fields hold; true if that is anything but what was there at first. */
function copy(from, to) {
  let isUsed = false;
  for (const [k, field] of [...from.elements].entries()) {
    const same = to.elements[k];
    if (!same || same.name !== field.name || field.tagName === "BUTTON") continue;
    isUsed ||= field.value !== field.defaultValue && "defaultValue" in field && field.type !== "radio";
    if (field.type === "radio") same.checked = field.checked;
    else if (field.tagName !== "FIELDSET") same.value = field.value;
  }
  return isUsed;
}
