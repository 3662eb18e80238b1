// Downloads: what is asked for, and how far what was asked for is, as it happens.

import { ask, AskError, clear, fail } from "../ask.js";
import { all, el, one, setText } from "../dom.js";
import { listen } from "../feed.js";
import { keep } from "../pieces.js";
import { t } from "../strings.js";
import { fieldStamp, fieldText, local } from "../time.js";

const MOST_ROBOTS = 5;
const MOST_MISSIONS = 12;
const form = one("#ask");
const words = (text) => text.split(/[\s,]+/).filter(Boolean);
const known = new Set();
const stale = keep(() => one("#jobs"), () => `/pieces/downloads${location.search}`);

/** Show a time of the address in the viewer's zone. */
function localise(field) {
  const exact = Date.parse(field.dataset.at ?? "");
  if (Number.isNaN(exact)) return;
  const ms = field.name === "to" ? Math.ceil(exact / 1000) * 1000 : exact; // nothing is cut off
  field.value = fieldText(ms);
}

const utc = (field) => fieldStamp(field.value);
const chosen = (name) => all(`input[name="${name}"]:checked`, form).map((box) => box.value);

/** Return the chips that are pressed, and what was typed beside them. */
function picked(kind) {
  const pressed = all(`[data-chips="${kind}"] [aria-pressed="true"]`, form).map((button) => button.value);
  return [...new Set([...pressed, ...words(form.elements[kind].value)])];
}

/** Read the form as the API wants it; throws AskError. */
function wanted() {
  const { from, to } = form.elements;
  const [span] = chosen("span");
  const robots = chosen("robot");
  if (!robots.length) throw new AskError(t("downloads.no_robot"), t("downloads.no_robot_hint"), 0);
  const body = { robots, items: picked("items"), format: chosen("format")[0] };
  if (span === "range") return { ...body, from: utc(from), to: utc(to) };
  if (span === "all") return body;
  const missions = picked("missions");
  if (!missions.length) throw new AskError(t("downloads.no_mission"), t("downloads.no_mission_hint"), 0);
  return { ...body, missions };
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
  for (const robot of chosen("robot").slice(0, MOST_ROBOTS)) {
    if (known.has(robot)) continue;
    known.add(robot);
    const base = `/api/v1/robots/${encodeURIComponent(robot)}`;
    const missions = await ask(`${base}/missions?limit=${MOST_MISSIONS}`).catch(() => []); // ids can be typed
    for (const one of missions) chip("missions", one.id, t("downloads.mission", { name: one.name || one.id, at: local(Date.parse(one.from)) }));
    const items = await ask(`${base}/items`).catch(() => []); // as above
    for (const { name } of items.filter((item) => item.source !== "amberbox")) chip("items", name, name);
  }
}

function chip(kind, value, text) {
  const place = one(`[data-chips="${kind}"]`, form);
  const there = all("button", place).find((button) => button.value === value);
  if (there) setText(there, text);
  else place.append(el("button", { class: "chip", type: "button", value, "aria-pressed": "false" }, text));
}

function press(button) {
  button.setAttribute("aria-pressed", String(button.getAttribute("aria-pressed") !== "true"));
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
  });
  form.addEventListener("click", ({ target }) => {
    const pressed = target.closest("[data-chips] button");
    if (pressed) press(pressed);
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
