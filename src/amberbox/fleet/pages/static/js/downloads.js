// Downloads: what is asked for, and how far what was asked for is, as it happens.

import { ask, AskError, clear, fail } from "./ask.js";
import { all, el, one } from "./dom.js";
import { listen } from "./feed.js";
import { keep } from "./pieces.js";
import { t } from "./strings.js";

const form = one("#ask");
const words = (text) => text.split(/[\s,]+/).filter(Boolean);
const known = new Set();
const stale = keep(() => one("#jobs"), () => `/pieces/downloads${location.search}`);

/** Show a time of the address in the viewer's zone. */
function localise(field) {
  const ms = Date.parse(field.dataset.at ?? "");
  if (Number.isNaN(ms)) return;
  field.value = new Date(ms - new Date(ms).getTimezoneOffset() * 60_000).toISOString().slice(0, 19);
}

const utc = (field) => (field.value ? new Date(field.value).toISOString() : "");
const chosen = (name) => all(`input[name="${name}"]:checked`, form).map((box) => box.value);

/** Read the form as the API wants it; throws AskError. */
function wanted() {
  const { items, missions, from, to } = form.elements;
  const [span] = chosen("span");
  const robots = chosen("robot");
  if (!robots.length) throw new AskError(t("downloads.no_robot"), t("downloads.no_robot_hint"), 0);
  const body = { robots, items: words(items.value), format: chosen("format")[0] };
  if (span === "range") return { ...body, from: utc(from), to: utc(to) };
  if (span === "all") return body;
  if (!words(missions.value).length) throw new AskError(t("downloads.no_mission"), t("downloads.no_mission_hint"), 0);
  return { ...body, missions: words(missions.value) };
}

async function send(button) {
  clear(form);
  button.setAttribute("aria-busy", "true");
  try {
    await ask("/api/v1/downloads", { method: "POST", body: wanted() });
    form.closest("details").open = false;
    stale();
    one("#jobs").scrollIntoView({ block: "nearest" });
  } catch (error) {
    fail(error, form);
  } finally {
    button.removeAttribute("aria-busy");
  }
}

function showSpan() {
  for (const part of all("[data-span]", form)) part.hidden = part.dataset.span !== chosen("span")[0];
}

/** Offer what the chosen robots have, each name once. */
async function offer() {
  for (const robot of chosen("robot").slice(0, 5)) {
    if (known.has(robot)) continue;
    known.add(robot);
    const base = `/api/v1/robots/${encodeURIComponent(robot)}`;
    const items = await ask(`${base}/items`).catch(() => []); // names can be typed as well
    const missions = await ask(`${base}/missions?limit=20`).catch(() => []); // as above
    for (const { name } of items.filter((item) => item.source !== "amberbox")) offerItem(name);
    one("#missions-known").append(...missions.map(({ id, name }) => el("option", { value: id }, name)));
  }
}

function offerItem(name) {
  const place = one("[data-items]", form);
  if (all("button", place).some((button) => button.value === name)) return;
  const add = () => {
    const { items } = form.elements;
    const there = words(items.value);
    items.value = (there.includes(name) ? there.filter((other) => other !== name) : [...there, name]).join(" ");
    showItems();
  };
  place.append(el("button", { class: "chip", type: "button", value: name, onclick: add }, name));
  place.hidden = false;
  showItems();
}

function showItems() {
  const there = words(form.elements.items.value);
  for (const button of all("[data-items] button", form)) button.setAttribute("aria-pressed", String(there.includes(button.value)));
}

function start() {
  all("[data-at]", form).forEach(localise);
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    send(event.submitter ?? one("button.primary", form));
  });
  form.addEventListener("change", ({ target }) => {
    if (target.name === "span") showSpan();
    if (target.name === "robot") offer();
    if (target.name === "items") showItems();
  });
  one("[data-all]", form)?.addEventListener("click", () => {
    for (const box of all('input[name="robot"]', form)) box.checked = true;
    offer();
  });
  form.closest("details").addEventListener("toggle", ({ target }) => target.open && offer());
  if (form.closest("details").open) offer();
}

if (form.elements.length) start();
one("#downloads").addEventListener("done", stale);
const feed = listen({ robots: [], kinds: ["job"] });
feed.on("job", stale);
feed.on("snapshot", stale);
