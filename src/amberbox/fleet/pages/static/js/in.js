// Signs in by the code behind the # of a one-time link. It never stands in a path, nor in a log.

import { ask } from "./ask.js";
import { one, setText } from "./dom.js";

begin(one("#in"));

/** @param {HTMLElement} box */
async function begin(box) {
  const code = taken();
  if (!code) return failed(box, "");
  try {
    await ask("/api/v1/session/code", { method: "POST", body: { code } });
    location.replace("/");
  } catch (error) {
    failed(box, error.message);
  }
}

/** Take the code out of the address, so that neither history nor a bookmark keeps it. */
function taken() {
  const code = location.hash.slice(1);
  history.replaceState(null, "", location.pathname);
  return code;
}

/** Say why it did not work. @param {HTMLElement} box @param {string} why what the server says */
function failed(box, why) {
  one("[data-busy]", box).hidden = true;
  if (why) setText(one("[data-why]", box), why);
  one("[data-failed-in]", box).hidden = false;
}
