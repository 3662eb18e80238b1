// The page of words: finds one by a part of it.

import { all, one } from "./dom.js";
import * as view from "./view.js";

const input = one("#help-search");

/** Show the words that have a text in their name or meaning. @param {string} text */
function show(text) {
  const wanted = text.trim().toLowerCase();
  for (const word of all(".word-entry")) word.hidden = !word.textContent.toLowerCase().includes(wanted);
  for (const part of all("main section.panel:has(.words)")) part.hidden = !one(".word-entry:not([hidden])", part);
  one("#help-none").hidden = one(".word-entry:not([hidden])") !== null;
}

/** Open what the address points to. */
function reveal() {
  const word = document.getElementById(location.hash.slice(1));
  const around = word?.closest("details");
  if (around) around.open = true;
  word?.scrollIntoView({ block: "center" });
}

input.closest("label").hidden = false;
input.value = view.get("q");
input.addEventListener("input", () => {
  view.set({ q: input.value });
  show(input.value);
});
show(input.value);
reveal();
addEventListener("hashchange", reveal);
