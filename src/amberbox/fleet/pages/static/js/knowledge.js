// The sheet of failure modes follows what one looks for, without a button.

import { one } from "./dom.js";

const PAUSE_MS = 500;
const form = one("#sheet-look");
let timer = 0;

form.addEventListener("change", () => form.requestSubmit());
form.addEventListener("input", (event) => {
  if (event.target.name !== "q") return;
  clearTimeout(timer);
  timer = setTimeout(() => form.requestSubmit(), PAUSE_MS);
});
form.addEventListener("submit", () => sessionStorage.setItem("sheet", form.contains(document.activeElement) ? document.activeElement.name : ""));

const field = form.elements[sessionStorage.getItem("sheet") ?? ""];
if (field && location.hash === "#modes") {
  field.focus();
  if (field.type === "search") field.setSelectionRange(field.value.length, field.value.length);
}
sessionStorage.removeItem("sheet");
