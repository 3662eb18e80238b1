// A command: what changes follows the feed; one that changes a state can be signed here.

import { whileBusy } from "./api.js";
import { followParts } from "./command_parts.js";
import { showKeyState, SIGN_AT_ONCE, signAndHold, usableKey } from "./command_signing.js";
import { el, find, setText } from "./dom.js";

const { robot, command, person } = find("#command").dataset;
let usable = null;
let isSigning = false;

const order = () => JSON.parse(find("#command-now").dataset.order);

function offerSigning() {
  if (!usable || isSigning) return;
  showKeyState(find("#command-sign [data-key-state]"), usable.text);
  const button = find("[data-sign-here]");
  if (button) button.hidden = !usable.key;
}

/** Sign the command that the page shows, and show beside it what happens. */
async function signHere() {
  isSigning = true;
  find("[data-sign-here]").hidden = true;
  const said = el("p", { role: "status", class: "notice" });
  find("#signing")?.remove(); // of an attempt before
  const place = el("section", { class: "card stack", id: "signing" }, said);
  find("#command-sign").before(place);
  const error = await whileBusy(place, null, () => signAndHold(order(), usable.key, (text) => setText(said, text)));
  isSigning = false;
  said.remove();
  if (!error) place.remove();
  refresh();
}

async function start() {
  if (!find("[data-sign-here]")) return;
  usable = await usableKey(person);
  offerSigning();
  const isOrdered = sessionStorage.getItem(SIGN_AT_ONCE) === command;
  if (isOrdered) sessionStorage.removeItem(SIGN_AT_ONCE);
  if (isOrdered && usable.key) signHere();
}

document.addEventListener("click", (event) => {
  if (event.target.closest("[data-sign-here]")) signHere();
});
const refresh = followParts([robot], () => `/pieces/robots/${encodeURIComponent(robot)}/commands/${command}`, offerSigning);
start();
