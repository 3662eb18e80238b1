// Places whose content the server did not put on the page: `data-fill` says where it is. Those in
// something that is closed are filled when it opens, the others at once.

import { fail } from "./ask.js";
import { all } from "./dom.js";
import { piece, put } from "./pieces.js";

/** Put what a place waits for in its stead. @param {HTMLElement} place */
async function fill(place) {
  const address = place.dataset.fill;
  delete place.dataset.fill;
  try {
    put(place, await piece(address));
  } catch (error) {
    place.dataset.fill = address; // when it opens again
    place.removeAttribute("aria-busy");
    fail(error, place);
  }
}

function fillOpen() {
  for (const place of all("[data-fill]")) if (!place.closest("details:not([open])")) fill(place);
}

document.addEventListener("toggle", ({ target }) => {
  if (target.open) fillOpen();
}, true);
fillOpen();
