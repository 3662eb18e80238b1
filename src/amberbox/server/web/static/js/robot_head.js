// The head of all pages of a robot: its status and whether it is online, kept current.

import { SETTLED_MS } from "./diagnosis_card.js";
import { find, findAll } from "./dom.js";
import { subscribe } from "./feed.js";
import { throttledFragment } from "./fragments.js";
import { debounce, msToStamp, nowMs, updateTimes } from "./time.js";

const { robot } = find(".robot-head").dataset;
let rank = find("#robot-state").dataset.rank;
const refresh = throttledFragment(() => find("#robot-state"), () => `/pieces/robots/${encodeURIComponent(robot)}/head`, undefined, onHeadReplaced);

/** Dispatch `statuschange` when the status of the robot has changed. */
function onHeadReplaced() {
  const newRank = find("#robot-state").dataset.rank;
  if (newRank === rank) return;
  rank = newRank;
  dispatchEvent(new Event("statuschange"));
}

/** Tell whether the card of a snapshot differs from what the head shows. */
function differs(card) {
  const { rank, shown: json } = find("#robot-state").dataset;
  const shown = JSON.parse(json);
  return String(card.status.rank) !== rank || Object.entries(shown).some(([name, value]) => card[name] !== value);
}

const feed = subscribe({ robots: [robot], kinds: ["presence", "levels", "alarm", "diagnosis", "run", "ages"] });
feed.on("snapshot", ({ robots }) => {
  const card = robots.find((other) => other.robot === robot);
  if (card && differs(card)) refresh();
});
const refreshSettled = debounce(refresh, SETTLED_MS);
for (const kind of ["presence", "levels", "alarm", "diagnosis", "run"]) {
  feed.on(kind, () => {
    refresh();
    refreshSettled();
  });
}
// times at which the robot was last known to be as shown
feed.on("ages", ({ age_s: age }) => {
  for (const place of findAll("[data-as-of]")) {
    for (const shown of findAll("time", place)) shown.dateTime = msToStamp(nowMs() - 1000 * age);
    updateTimes(place);
  }
});
