// What there is of all robots: first what costs little, then robot by robot the rest.

import { all, el, icon, one } from "../dom.js";
import { piece, put } from "../pieces.js";
import { followStates } from "./state.js";
import * as view from "../view.js";

const wanted = new Set(all("[data-more]").map((more) => more.dataset.more));
let isBusy = false;

/** Fill in the rest of robots that want it, one after the other: workers answer in turns. */
async function fill() {
  if (isBusy) return;
  isBusy = true;
  for (const robot of wanted) {
    wanted.delete(robot);
    await more(robot);
  }
  isBusy = false;
}

async function more(robot) {
  const place = () => one(`[data-more="${CSS.escape(robot)}"]`);
  const query = new URLSearchParams({ window: view.get("window", "7d") });
  try {
    const fresh = await piece(`/pieces/recordings/${encodeURIComponent(robot)}?${query}`);
    if (place()) put(place(), fresh);
  } catch (error) {
    place()?.replaceChildren(el("p", { class: "problem", role: "alert" }, icon("error"), error.message));
  }
}

followStates("/pieces/recordings", (robot, isAll) => {
  if (!isAll) return;
  wanted.add(robot);
  fill();
});
fill();
