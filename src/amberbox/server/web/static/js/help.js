// The glossary: finds words by a part of their name or meaning.

import { find, findAll } from "./dom.js";
import { getParam, setParams } from "./url.js";

const input = find("#help-search");

/** Show the words that contain a text. @param {string} text */
function showMatches(text) {
  const needle = text.trim().toLowerCase();
  for (const word of findAll(".word-entry")) word.hidden = !word.textContent.toLowerCase().includes(needle);
  for (const part of findAll("main section.panel:has(.words)")) part.hidden = !find(".word-entry:not([hidden])", part);
  find("#help-none").hidden = find(".word-entry:not([hidden])") !== null;
}

/** Scroll to the word of the address, and open what contains it. */
function revealTarget() {
  const word = document.getElementById(location.hash.slice(1));
  const around = word?.closest("details");
  if (around) around.open = true;
  word?.scrollIntoView({ block: "center" });
}

input.closest("label").hidden = false;
input.value = getParam("q");
input.addEventListener("input", () => {
  setParams({ q: input.value });
  showMatches(input.value);
});
showMatches(input.value);
revealTarget();
addEventListener("hashchange", revealTarget);
