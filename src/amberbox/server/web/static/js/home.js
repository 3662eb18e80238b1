// The fleet: a list of robots with filters; each card follows its robot.

import { find, findAll, setText } from "./dom.js";
import { subscribe } from "./feed.js";
import { latestFragment, replaceElement, throttledFragment } from "./fragments.js";
import { getParam, onNavigation, setParams } from "./url.js";

const CARD_MS = 1000;
const LIST_MS = 5000;
const VALUES_MS = 30000;
const form = find("#look");
const cards = new Map();

const query = () => {
  const params = new URLSearchParams(location.search);
  return params.size ? `?${params}` : "";
};
const LIST = [() => find("#robots"), () => `/pieces/robots${query()}`];
const refreshList = throttledFragment(...LIST, LIST_MS, showChoices);
const showList = latestFragment(...LIST, showChoices);

function changeView(changes) {
  setParams(changes, { push: !("q" in changes) });
  showList();
}

/** Show the choices of the address in the form. */
function showChoices() {
  for (const chip of findAll('button[name="show"]', form)) {
    chip.setAttribute("aria-pressed", String(chip.value === getParam("show", "all")));
  }
  form.elements.sort.value = getParam("sort", "worst");
  form.elements.by.checked = getParam("by") === "team";
  const counts = JSON.parse(find("#robots").dataset.counts);
  for (const element of findAll("[data-count]", form)) setText(element, String(counts[element.dataset.count]));
}

/** Refresh the card of a robot, and its copies in other teams. */
function refreshCard(robot) {
  if (!cards.has(robot)) {
    const selector = `.robot-card[data-robot="${CSS.escape(robot)}"]`;
    const updateCopies = (fresh) => findAll(selector).forEach((card) => card !== fresh && replaceElement(card, fresh.cloneNode(true)));
    cards.set(robot, throttledFragment(() => find(selector), () => `/pieces/robots/${encodeURIComponent(robot)}`, CARD_MS, updateCopies));
  }
  cards.get(robot)();
}

form.addEventListener("submit", (event) => event.preventDefault());
form.addEventListener("input", (event) => {
  if (event.target.name === "q") changeView({ q: event.target.value.trim() });
});
form.addEventListener("change", (event) => {
  const { name, value, checked } = event.target;
  if (name === "sort") changeView({ sort: value === "worst" ? null : value });
  if (name === "by") changeView({ by: checked ? "team" : null });
});
form.addEventListener("click", (event) => {
  const chip = event.target.closest('button[name="show"]');
  if (chip) changeView({ show: chip.value === "all" ? null : chip.value });
});
onNavigation(() => changeView({}));

// changes of values alone come with the list
const feed = subscribe({ kinds: ["presence", "levels", "alarm", "diagnosis", "run", "command"] });
for (const kind of ["presence", "levels", "alarm", "diagnosis", "run"]) {
  feed.on(kind, (_, robot) => {
    const isReloaded = refreshList(); // the order and the counts may have changed
    if (robot && !isReloaded) refreshCard(robot);
  });
}
feed.on("command", throttledFragment(() => find("#unsigned-count"), () => "/pieces/commands/count"));
feed.on("snapshot", () => refreshList());
setInterval(refreshList, VALUES_MS);
