// The audit log is followed from its first row to its last.

import { ask, clear, fail } from "./ask.js";
import { level, one } from "./dom.js";
import { t } from "./strings.js";

const button = one("#verify");
const verdict = one("#verdict");

button.addEventListener("click", async () => {
  clear(button.parentElement);
  button.setAttribute("aria-busy", "true");
  try {
    const { holds, rows, broken, what } = await ask("/api/v1/audit/verify");
    const text = holds ? t("audit.holds", { n: rows }) : t("audit.broken", { n: broken, what });
    verdict.replaceChildren(level(holds ? "ok" : "error", text));
  } catch (error) {
    fail(error, button.parentElement);
  } finally {
    button.removeAttribute("aria-busy");
  }
});
