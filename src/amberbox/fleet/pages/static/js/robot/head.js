// The head of all pages of a robot: how it is and whether it is there, as that changes.

import { all, one } from "../dom.js";
import { listen } from "../feed.js";
import { SETTLED_MS } from "../diagnosis/card.js";
import { keep } from "../pieces.js";
import { nowMs, refresh, rfc3339 } from "../time.js";

const { robot } = one(".robot-head").dataset;
let rank = one("#robot-state").dataset.rank;
const stale = keep(() => one("#robot-state"), () => `/pieces/robots/${encodeURIComponent(robot)}/head`, undefined, changed);

/** Tell the page when the status of its robot is another one: what is derived from it is fetched anew. */
function changed() {
  const now = one("#robot-state").dataset.rank;
  if (now === rank) return;
  rank = now;
  dispatchEvent(new Event("statuschange"));
}

/** Tell whether the head shows something else than the server knows now. */
function isOther(card) {
  const { rank, shown: told } = one("#robot-state").dataset;
  const shown = JSON.parse(told);
  return String(card.status.rank) !== rank || Object.entries(shown).some(([name, value]) => card[name] !== value);
}

const feed = listen({ robots: [robot], kinds: ["presence", "levels", "alarm", "diagnosis", "ages"] });
feed.on("snapshot", ({ robots }) => {
  const card = robots.find((known) => known.robot === robot);
  if (card && isOther(card)) stale();
});
let settling = null;
for (const kind of ["presence", "levels", "alarm", "diagnosis"]) {
  feed.on(kind, () => {
    stale();
    clearTimeout(settling);
    settling = setTimeout(stale, SETTLED_MS);
  });
}
// what stands as of now does so as long as the robot says so
feed.on("ages", ({ age_s: age }) => {
  for (const place of all("[data-as-of]")) {
    for (const shown of all("time", place)) shown.dateTime = rfc3339(nowMs() - 1000 * age);
    refresh(place);
  }
});
