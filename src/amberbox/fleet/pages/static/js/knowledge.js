// The sheet of failure modes follows what one looks for, without a button.

import { one } from "./dom.js";

const PAUSE_MS = 500;
const form = one("#sheet-look");
let timer = 0;
let used = "";

// No fragment: going to one takes the focus from whatever has it, some time after this ran.
form.action = location.pathname;
form.addEventListener("change", () => form.requestSubmit());
form.addEventListener("input", (event) => {
  used = event.target.name;
  if (event.target.name !== "q") return;
  clearTimeout(timer);
  timer = setTimeout(() => form.requestSubmit(), PAUSE_MS);
});
form.addEventListener("submit", () => sessionStorage.setItem("sheet", held()));

const field = form.elements[sessionStorage.getItem("sheet") ?? ""];
if (field) {
  one("#modes").scrollIntoView();
  field.focus({ preventScroll: true });
  if (field.type === "search") field.setSelectionRange(field.value.length, field.value.length);
}
sessionStorage.removeItem("sheet");

/** Name the field that has the focus; the one used last when nothing has it. */
function held() {
  const active = document.activeElement;
  if (active === document.body) return used;
  return form.contains(active) ? active.name : "";
}
