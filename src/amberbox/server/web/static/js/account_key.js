// The signing key of this browser on the page of one's account: make, show and forget it.

import { requestJson, whileBusy } from "./api.js";
import { forgetKey, loadKey, makeKey, obstacle } from "./browser_key.js";
import { showKeyState } from "./command_signing.js";
import { find, setText } from "./dom.js";
import { t } from "./strings.js";
import { updateTimes } from "./time.js";

const panel = find("#browser-key");

async function show() {
  const why = await obstacle();
  if (why) {
    showKeyState(find("[data-key-state]", panel), t(`commands.${why}`));
    return;
  }
  const { person, server } = panel.dataset;
  const key = await loadKey(person);
  find("[data-no-key]", panel).hidden = key !== null;
  find("[data-key]", panel).hidden = key === null;
  find("[data-key-state]", panel).hidden = true;
  if (!key) return;
  setText(find("[data-key-line]", panel), key.text);
  setText(find("[data-key-id]", panel), key.id);
  find("[data-key-made]", panel).dateTime = key.made;
  updateTimes(panel);
  setText(find("[data-key-trust]", panel), `server: ${server}\npeople:\n  ${person}-browser: {key: "${key.text}", risk: state}`);
  const revoking = find("[data-revoke-key]", panel);
  if (revoking) revoking.elements.key_id.value = key.id;
  const revoked = await requestJson("/api/v1/revoked-keys");
  if (revoked.some((one) => one.key_id === key.id)) {
    showKeyState(find("[data-key-state]", panel), t("commands.revoked", { id: key.id }));
    if (revoking) revoking.hidden = true;
  }
}

/** Let a button do something with the key, and show what there is then. */
function onClick(selector, work) {
  const button = find(selector, panel);
  button.addEventListener("click", () => whileBusy(find(".body", panel), button, async () => {
    await work();
    button.closest("dialog")?.close();
    await show();
  }));
}

if (panel) {
  onClick("[data-make-key]", () => makeKey(panel.dataset.person));
  onClick("[data-forget-key]", () => forgetKey(panel.dataset.person));
  show();
}
