// Pages of runs: their parts follow the feed, their plain forms are sent without loading the page,
// and somebody who looks at one is there for the run.

import { ApiError, requestJson, robotApi, send, showError, signIn, whileBusy } from "./api.js";
import { find, setText } from "./dom.js";
import { subscribe } from "./feed.js";
import { placeParts, throttledFragment } from "./fragments.js";
import { t } from "./strings.js";

const PAUSE_MS = 300;
const PRESENT_MS = 10000;
const KINDS = ["run", "command", "presence"];

/**
 * Keep the parts of a run current.
 * @param {string} id the element that holds the parts
 * @param {{address: () => string, robots: ?string[], run: () => string, robot: () => string,
 *   role: () => string, placed?: () => void}} about
 */
export function keepRunCurrent(id, { address, robots, run, robot, role, placed = () => {} }) {
  const parts = () => document.getElementById(id);
  const refresh = throttledFragment(parts, address, PAUSE_MS, announce, placeParts);

  let said = parts().dataset.news; // what the page began with is read anyhow

  function announce() {
    const { news } = parts().dataset;
    if (news !== said) setText(find("#run-news"), news);
    said = news;
    placed();
  }

  async function submit(form, button) {
    const error = await whileBusy(form, button, async () => {
      const page = await sendForm(form, button);
      const fresh = page.getElementById(id);
      if (!fresh) throw new ApiError(find(".problem strong", page)?.textContent ?? t("common.unreachable"), find(".problem p", page)?.textContent ?? "", 0);
      placeParts(parts(), document.adoptNode(fresh), form.id); // another may have taken its place meanwhile
      announce();
      if (document.activeElement === document.body) focusStep(parts()); // what had the focus is gone
      find(`#${id} [role="alert"]`)?.scrollIntoView({ block: "nearest" });
    });
    if (error?.status === 0) showError(new ApiError(t("runs.kept"), "", 0), form.isConnected ? form : null);
  }

  document.addEventListener("submit", (event) => {
    if (!event.target.matches(`#${id} form[data-plain]`)) return;
    event.preventDefault();
    submit(event.target, event.submitter);
  });

  function bePresent() {
    if (document.hidden || !run() || !role()) return;
    const path = `${robotApi(robot())}/runs/${encodeURIComponent(run())}/present`;
    requestJson(path, { method: "POST", body: { role: role() } }).catch(() => null); // said again soon
  }

  const feed = subscribe({ robots, kinds: KINDS });
  for (const kind of [...KINDS, "snapshot"]) feed.on(kind, refresh);
  bePresent();
  setInterval(bePresent, PRESENT_MS);
  document.addEventListener("visibilitychange", bePresent);
  return { feed, bePresent };
}

/** Put the focus on the step that is shown now, so that the next Tab is inside it. */
function focusStep(parts) {
  const step = find(".run-step", parts) ?? parts;
  step.tabIndex = -1;
  step.focus({ preventScroll: true });
}

/** Send a plain form as the browser would; return the page that answers. Throws ApiError. */
async function sendForm(form, button) {
  const body = new URLSearchParams(new FormData(form, button));
  const response = await send(form.action, { method: "POST", body, headers: { Accept: "text/html" } });
  if (response.redirected && new URL(response.url).pathname === "/sign-in") signIn();
  return new DOMParser().parseFromString(await response.text(), "text/html");
}
