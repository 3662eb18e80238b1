// The head of all pages of a robot: how it is and whether it is there, as that changes.

import { one } from "../dom.js";
import { listen } from "../feed.js";
import { keep } from "../pieces.js";

const { robot } = one(".robot-head").dataset;
const stale = keep(() => one("#robot-state"), () => `/pieces/robots/${encodeURIComponent(robot)}/head`);

/** Tell whether the head shows something else than the server knows now. */
function isOther(card) {
  const shown = JSON.parse(one("#robot-state").dataset.shown);
  return Object.entries(shown).some(([name, value]) => card[name] !== value);
}

const feed = listen({ robots: [robot], kinds: ["presence", "levels", "alarm"] });
feed.on("snapshot", ({ robots }) => {
  const card = robots.find((known) => known.robot === robot);
  if (card && isOther(card)) stale();
});
for (const kind of ["presence", "levels", "alarm"]) feed.on(kind, () => stale());
