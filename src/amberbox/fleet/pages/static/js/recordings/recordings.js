// What there is of all robots: first what costs little, then robot by robot the rest.

import { all, el, icon, one } from "../dom.js";
import { piece, put } from "../pieces.js";
import { followStates } from "./state.js";

/** Robots in one question: as many as the server takes. */
const MOST = 200;
const wanted = new Set(all("[data-more]").map((more) => more.dataset.more));
/** The robots that one sees, or nearly. @type {Set<string>} */
const shown = new Set();
let isBusy = false;

/** Fill in the rest of robots that one sees, one after the other: workers answer in turns. */
async function fill() {
  if (isBusy) return;
  isBusy = true;
  for (let robot = next(); robot; robot = next()) {
    wanted.delete(robot);
    await more(robot);
  }
  isBusy = false;
}

const next = () => [...shown].find((robot) => wanted.has(robot));

async function more(robot) {
  const place = () => one(`[data-more="${CSS.escape(robot)}"]`);
  const query = new URLSearchParams({ window: one("#recordings").dataset.window });
  try {
    const fresh = await piece(`/pieces/recordings/${encodeURIComponent(robot)}?${query}`);
    if (place()) put(place(), fresh);
  } catch (error) {
    place()?.replaceChildren(el("p", { class: "problem", role: "alert" }, icon("error"), error.message));
  }
}

/** Follow robots as they come into sight, and go. */
function seen(entries) {
  for (const { target, isIntersecting } of entries) {
    if (isIntersecting) shown.add(target.dataset.robot);
    else shown.delete(target.dataset.robot);
  }
  soon();
  fill();
}

const { soon } = followStates(() => [...shown].slice(0, MOST), (robot, isAll) => {
  if (!isAll) return;
  wanted.add(robot);
  fill();
});
const eye = new IntersectionObserver(seen, { rootMargin: "300px" });
for (const card of all("#recordings article[data-robot]")) eye.observe(card);
