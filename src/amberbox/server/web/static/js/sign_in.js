// Sign in with the code of a one-time link. It stands behind the #, so that no log contains it.

import { requestJson } from "./api.js";
import { find, setText } from "./dom.js";

signIn(find("#in"));

/** @param {HTMLElement} box */
async function signIn(box) {
  const code = takeCode();
  if (!code) return showFailure(box, "");
  try {
    await requestJson("/api/v1/session/code", { method: "POST", body: { code } });
    location.replace("/");
  } catch (error) {
    showFailure(box, error.message);
  }
}

/** Remove the code from the address, so that neither history nor a bookmark keeps it. */
function takeCode() {
  const code = location.hash.slice(1);
  history.replaceState(null, "", location.pathname);
  return code;
}

/** Show that signing in failed. @param {HTMLElement} box @param {string} reason from the server */
function showFailure(box, reason) {
  find("[data-busy]", box).hidden = true;
  if (reason) setText(find("[data-why]", box), reason);
  find("[data-failed-in]", box).hidden = false;
}
