// The commands of a robot: what changes follows the feed; what changes a state can be signed here.

import { toHex } from "./command_bytes.js";
import { followParts } from "./command_parts.js";
import { showKeyState, SIGN_AT_ONCE, usableKey } from "./command_signing.js";
import { find, findAll } from "./dom.js";

const { robot, person, after } = find("#commands").dataset;

async function offerSigning() {
  const forms = findAll('#actions form[data-risk="state"]');
  const places = findAll("#actions [data-key-state]");
  if (!places.length) return; // the viewer has no permission
  const { key, text } = await usableKey(person);
  for (const place of places) showKeyState(place, text);
  for (const form of key ? forms : []) {
    find("[data-sign-and-send]", form).hidden = false;
  }
}

/** Give each order an id of its own, by which its page knows that it is to be signed at once. */
function onOrder(event) {
  const form = event.target.closest("#actions form");
  if (!form) return;
  form.elements.id.value = toHex(crypto.getRandomValues(new Uint8Array(16)));
  if (event.submitter?.matches("[data-sign-and-send]")) sessionStorage.setItem(SIGN_AT_ONCE, form.elements.id.value);
}

document.addEventListener("submit", onOrder);
offerSigning();
followParts([robot], () => `/pieces/robots/${encodeURIComponent(robot)}/commands${after ? `?after=${after}` : ""}`);
