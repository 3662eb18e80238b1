// Recordings of all robots: what is costly to find is loaded robot by robot, as they are seen.

import { el, find, findAll, icon } from "./dom.js";
import { fetchFragment, replaceElement } from "./fragments.js";
import { followStates } from "./recording_states.js";

// robots in one request: as many as the server takes
const MOST_ROBOTS = 200;
const pending = new Set(findAll("[data-more]").map((more) => more.dataset.more));
/** Robots on the screen, or nearly. @type {Set<string>} */
const visible = new Set();
let isLoading = false;

/** Load the details of visible robots, one after the other to spare the workers of the server. */
async function loadDetails() {
  if (isLoading) return;
  isLoading = true;
  for (let robot = nextRobot(); robot; robot = nextRobot()) {
    pending.delete(robot);
    await loadRobot(robot);
  }
  isLoading = false;
}

const nextRobot = () => [...visible].find((robot) => pending.has(robot));

async function loadRobot(robot) {
  const placeholder = () => find(`[data-more="${CSS.escape(robot)}"]`);
  const query = new URLSearchParams({ window: find("#recordings").dataset.window });
  try {
    const fresh = await fetchFragment(`/pieces/recordings/${encodeURIComponent(robot)}?${query}`);
    if (placeholder()) replaceElement(placeholder(), fresh);
  } catch (error) {
    placeholder()?.replaceChildren(el("p", { class: "problem", role: "alert" }, icon("error"), error.message));
  }
}

/** Follow which robots are on the screen. */
function onIntersection(entries) {
  for (const { target, isIntersecting } of entries) {
    if (isIntersecting) visible.add(target.dataset.robot);
    else visible.delete(target.dataset.robot);
  }
  updateSoon();
  loadDetails();
}

const { updateSoon } = followStates(() => [...visible].slice(0, MOST_ROBOTS), (robot, isAll) => {
  if (!isAll) return;
  pending.add(robot);
  loadDetails();
});
const observer = new IntersectionObserver(onIntersection, { rootMargin: "300px" });
for (const card of findAll("#recordings article[data-robot]")) observer.observe(card);
