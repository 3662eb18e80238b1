// The sheet of failure modes: its form of filters is submitted as soon as something changes.

import { find } from "./dom.js";
import { debounce } from "./time.js";

const PAUSE_MS = 500;
const form = find("#sheet-look");
const submitSoon = debounce(() => form.requestSubmit(), PAUSE_MS);
let lastUsed = "";

// without a fragment: going to one would take the focus away, some time after this ran
form.action = location.pathname;
form.addEventListener("change", () => form.requestSubmit());
form.addEventListener("input", (event) => {
  lastUsed = event.target.name;
  if (event.target.name === "q") submitSoon();
});
form.addEventListener("submit", () => sessionStorage.setItem("sheet", focusedField()));

const field = form.elements[sessionStorage.getItem("sheet") ?? ""];
if (field) {
  find("#modes").scrollIntoView();
  field.focus({ preventScroll: true });
  if (field.type === "search") field.setSelectionRange(field.value.length, field.value.length);
}
sessionStorage.removeItem("sheet");

/** Return the name of the focused field; of the one used last if nothing has the focus. */
function focusedField() {
  const active = document.activeElement;
  if (active === document.body) return lastUsed;
  return form.contains(active) ? active.name : "";
}
