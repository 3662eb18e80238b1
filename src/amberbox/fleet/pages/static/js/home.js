// The robots at a glance: the list follows what one looks for, each card follows its robot.

import { all, one, setText } from "./dom.js";
import { listen } from "./feed.js";
import { keep, put, swapper } from "./pieces.js";
import * as view from "./view.js";

const CARD_MS = 1000;
const LIST_MS = 5000;
const VALUES_MS = 30000;
const form = one("#look");
const cards = new Map();

const query = () => {
  const known = new URLSearchParams(location.search);
  return known.size ? `?${known}` : "";
};
const list = [() => one("#robots"), () => `/pieces/robots${query()}`];
const staleList = keep(...list, LIST_MS, mark);
const showList = swapper(...list, { placed: mark });

function look(changes) {
  view.set(changes, { push: !("q" in changes) });
  showList();
}

/** Show in the form what the address says. */
function mark() {
  for (const chip of all('button[name="show"]', form)) {
    chip.setAttribute("aria-pressed", String(chip.value === view.get("show", "all")));
  }
  form.elements.sort.value = view.get("sort", "worst");
  form.elements.by.checked = view.get("by") === "team";
  const counts = JSON.parse(one("#robots").dataset.counts);
  for (const shown of all("[data-count]", form)) setText(shown, String(counts[shown.dataset.count]));
}

/** Ask for a robot's card anew, in whichever teams it stands. */
function staleCard(robot) {
  if (!cards.has(robot)) {
    const selector = `.robot-card[data-robot="${CSS.escape(robot)}"]`;
    const others = (fresh) => all(selector).forEach((card) => card !== fresh && put(card, fresh.cloneNode(true)));
    cards.set(robot, keep(() => one(selector), () => `/pieces/robots/${encodeURIComponent(robot)}`, CARD_MS, others));
  }
  cards.get(robot)();
}

form.addEventListener("submit", (event) => event.preventDefault());
form.addEventListener("input", (event) => {
  if (event.target.name === "q") look({ q: event.target.value.trim() });
});
form.addEventListener("change", (event) => {
  const { name, value, checked } = event.target;
  if (name === "sort") look({ sort: value === "worst" ? null : value });
  if (name === "by") look({ by: checked ? "team" : null });
});
form.addEventListener("click", (event) => {
  const chip = event.target.closest('button[name="show"]');
  if (chip) look({ show: chip.value === "all" ? null : chip.value });
});
view.on(() => look({}));

// not of values alone: the list brings them
const feed = listen({ kinds: ["presence", "levels", "alarm", "diagnosis"] });
for (const kind of ["presence", "levels", "alarm", "diagnosis"]) {
  feed.on(kind, (_, robot) => {
    const isComing = staleList(); // its place and the counts may be others now
    if (robot && !isComing) staleCard(robot);
  });
}
feed.on("snapshot", () => staleList());
setInterval(staleList, VALUES_MS);
