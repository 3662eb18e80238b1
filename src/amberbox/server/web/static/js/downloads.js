// Downloads: the form that starts one, and the list of jobs with their progress.

import { ApiError, requestJson, robotApi, whileBusy } from "./api.js";
import { el, find, findAll, setText } from "./dom.js";
import { subscribe } from "./feed.js";
import { throttledFragment } from "./fragments.js";
import { t } from "./strings.js";
import { fieldToStamp, localTime, msToField } from "./time.js";

const MOST_ROBOTS = 5;
const MOST_MISSIONS = 12;
const form = find("#ask");
const splitWords = (text) => text.split(/[\s,]+/).filter(Boolean);
const offered = new Set();
const refreshJobs = throttledFragment(() => find("#jobs"), () => `/pieces/downloads${location.search}`);

/** Write the time of a field in the viewer's zone. */
function toLocalField(field) {
  const exact = Date.parse(field.dataset.at ?? "");
  if (Number.isNaN(exact)) return;
  const ms = field.name === "to" ? Math.ceil(exact / 1000) * 1000 : exact; // rounded up, so that nothing is cut off
  field.value = msToField(ms);
}

const utc = (field) => fieldToStamp(field.value);
const checkedValues = (name) => findAll(`input[name="${name}"]:checked`, form).map((box) => box.value);

/** Return the values of pressed chips, and those typed beside them. */
function chosenOf(kind) {
  const pressed = findAll(`[data-chips="${kind}"] [aria-pressed="true"]`, form).map((button) => button.value);
  return [...new Set([...pressed, ...splitWords(form.elements[kind].value)])];
}

/** Return the request for the API; throws ApiError. */
function requestBody() {
  const { from, to } = form.elements;
  const [span] = checkedValues("span");
  const robots = checkedValues("robot");
  if (!robots.length) throw new ApiError(t("downloads.no_robot"), t("downloads.no_robot_hint"), 0);
  const body = { robots, items: chosenOf("items"), format: checkedValues("format")[0] };
  if (span === "range") return { ...body, from: utc(from), to: utc(to) };
  if (span === "all") return body;
  const missions = chosenOf("missions");
  if (!missions.length) throw new ApiError(t("downloads.no_mission"), t("downloads.no_mission_hint"), 0);
  return { ...body, missions };
}

async function createDownload() {
  await requestJson("/api/v1/downloads", { method: "POST", body: requestBody() });
  form.closest("details").open = false;
  refreshJobs();
  find("#jobs").scrollIntoView({ block: "nearest" });
}

function showSpanFields() {
  for (const part of findAll("[data-span]", form)) part.hidden = part.dataset.span !== checkedValues("span")[0];
}

/** Offer the missions and items of the chosen robots. */
async function offerChoices() {
  for (const robot of checkedValues("robot").slice(0, MOST_ROBOTS)) {
    if (offered.has(robot)) continue;
    offered.add(robot);
    const base = robotApi(robot);
    const missions = await requestJson(`${base}/missions?limit=${MOST_MISSIONS}`).catch(() => []); // ids can be typed
    for (const one of missions) addChip("missions", one.id, t("downloads.mission", { name: one.name || one.id, at: localTime(Date.parse(one.from)) }));
    const items = await requestJson(`${base}/items`).catch(() => []); // names can be typed
    for (const { name } of items.filter((item) => item.source !== "amberbox")) addChip("items", name, name);
  }
}

function addChip(kind, value, text) {
  const place = find(`[data-chips="${kind}"]`, form);
  const existing = findAll("button", place).find((button) => button.value === value);
  if (existing) setText(existing, text);
  else place.append(el("button", { class: "chip", type: "button", value, "aria-pressed": "false" }, text));
}

function start() {
  findAll("[data-at]", form).forEach(toLocalField);
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    whileBusy(form, event.submitter ?? find("button.primary", form), createDownload);
  });
  form.addEventListener("change", ({ target }) => {
    if (target.name === "span") showSpanFields();
    if (target.name === "robot") offerChoices();
  });
  form.addEventListener("click", ({ target }) => {
    const pressed = target.closest("[data-chips] button");
    pressed?.setAttribute("aria-pressed", String(pressed.getAttribute("aria-pressed") !== "true"));
  });
  find("[data-all]", form)?.addEventListener("click", () => {
    for (const box of findAll('input[name="robot"]', form)) box.checked = true;
    offerChoices();
  });
  form.closest("details").addEventListener("toggle", ({ target }) => target.open && offerChoices());
  if (form.closest("details").open) offerChoices();
}

if (form.elements.length) start();
find("#downloads").addEventListener("done", refreshJobs);
const feed = subscribe({ robots: [], kinds: ["job"] });
feed.on("job", refreshJobs);
feed.on("snapshot", refreshJobs);
