// The new password is typed twice: both have to be the same before anything is sent.

import { all } from "./dom.js";

for (const again of all("[data-again]")) {
  const first = again.form.elements[again.dataset.again];
  const compare = () => again.setCustomValidity(first.value === again.value ? "" : again.dataset.differ);
  first.addEventListener("input", compare);
  again.addEventListener("input", compare);
}
