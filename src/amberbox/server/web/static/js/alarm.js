// One alarm: its parts follow what happens; what somebody is writing in its forms stays.

import { showError, toast } from "./api.js";
import { keepCardCurrent } from "./diagnosis_card.js";
import { find, findAll, setText } from "./dom.js";
import { subscribe } from "./feed.js";
import { copyInputs, fetchFragment, replaceElement } from "./fragments.js";
import { t } from "./strings.js";
import { fieldToStamp, msToStamp, updateTimes } from "./time.js";

const MORNING_H = 7;
const PARTS = ["alarm-head", "alarm-later", "alarm-links", "alarm-rest"];

/** Give the choices of shelving their times, and show the field of another time when it is chosen. */
function startShelveForm(section) {
  const shelve = find("#shelve", section);
  if (!shelve) return;
  shelve.addEventListener("change", () => fillShelveForm(shelve));
  shelve.addEventListener("input", () => fillShelveForm(shelve));
  fillShelveForm(shelve);
}

function fillShelveForm(shelve) {
  const ownTime = find("[data-own-time]", shelve);
  const radio = find('[data-until="own"]', shelve);
  find('[data-until="tomorrow"]', shelve).value = msToStamp(tomorrowMorning());
  if (ownTime.value) radio.value = fieldToStamp(ownTime.value);
  ownTime.hidden = !radio.checked;
  ownTime.required = radio.checked;
}

function tomorrowMorning() {
  const at = new Date();
  at.setDate(at.getDate() + 1);
  at.setHours(MORNING_H, 0, 0, 0);
  return at;
}

/**
 * Return the fresh section with the inputs of the forms of the old one, except of the form that was
 * sent. A form with inputs keeps the revision that its writer saw: the server refuses an outdated one.
 */
function carryInputs(old, fresh, sent) {
  for (const form of findAll("form[id]", old)) {
    const freshForm = find(`#${form.id}`, fresh);
    if (!freshForm || form === sent) continue;
    const isUsed = copyInputs(form, freshForm);
    if (isUsed && !("seen" in form.dataset)) freshForm.dataset.body = form.dataset.body;
    for (const error of findAll(":scope > [data-failed]", form)) freshForm.append(error);
  }
  for (const details of findAll("details[open]", old)) {
    if (!details.contains(sent)) find(`#${details.id}`, fresh)?.setAttribute("open", "");
  }
  return fresh;
}

/** Let the form of an element take the next revision along: its writer knows of the conflict. */
function acceptRevision(element) {
  const form = element.closest("form");
  if (form) form.dataset.seen = "";
}

/** Put the fresh section in place; the focus stays where it was. */
function placeForms(old, fresh) {
  const selector = old.contains(document.activeElement) ? focusSelector(document.activeElement) : null;
  updateTimes(fresh);
  old.replaceWith(fresh);
  startShelveForm(fresh);
  if (selector) (find(selector, fresh) ?? find("#alarm-act-title")).focus({ preventScroll: true });
}

function focusSelector(element) {
  const form = element.closest("form[id]");
  const field = element.name ? `[name="${element.name}"]` : element.tagName.toLowerCase();
  if (form) return `#${form.id} ${field}${element.type === "radio" ? ":checked" : ""}`;
  const details = element.closest("details[id]");
  return details ? `#${details.id} > summary` : "summary, button";
}

const page = find("#alarm");
const { alarm, robot } = page.dataset;
const feed = subscribe({ kinds: ["alarm", "diagnosis"] });
let requests = 0;

/** Fetch the parts and put them in place. @param {?HTMLFormElement} sent the form that was sent just now */
async function renewAlarm(sent = null) {
  const request = (requests += 1);
  const fresh = await fetchFragment(`/pieces/alarms/${alarm}`);
  if (request !== requests) return;
  const before = find("#alarm-head").dataset.revision;
  const section = carryInputs(find("#alarm-act"), find("#alarm-act", fresh), sent);
  for (const id of PARTS) replaceElement(find(`#${id}`), find(`#${id}`, fresh));
  placeForms(find("#alarm-act"), section);
  showDiagnosis(find("#alarm-diagnosis", fresh));
  if (!sent && find("#alarm-head").dataset.revision !== before) showNews();
}

/** Show who changed what: the first line of the history. */
function showNews() {
  const newest = find("#alarm-rest .alarm-history li");
  if (!newest) return;
  const what = find("strong", newest).textContent;
  const { who } = newest.dataset;
  const news = find("#alarm-news");
  setText(news, who ? t("alarms.changed", { who, what }) : t("alarms.changed_itself", { what }));
  news.hidden = false;
}

/** Replace the diagnosis if it is another one: it often comes after its alarm. */
function showDiagnosis(fresh) {
  const place = find("#alarm-diagnosis");
  if (["diagnosis", "kept"].every((key) => fresh.dataset[key] === place.dataset[key])) return;
  place.replaceWith(fresh);
  startDiagnosis();
}

/** Renew and ignore errors: the feed tells when the server is back. */
function renewQuietly() {
  return renewAlarm().catch(() => null);
}

function startDiagnosis() {
  const place = find("#alarm-diagnosis");
  const { diagnosis, kept } = place.dataset;
  if (!diagnosis) return;
  const query = new URLSearchParams({ diagnosis, ...(kept ? { revision: kept } : {}) });
  const path = () => `/robots/${encodeURIComponent(robot)}/diagnosis/card?${query}`;
  keepCardCurrent(place, { path, feed, robot, renewed: renewQuietly });
}

page.addEventListener("done", ({ target }) => {
  if (!target.closest("#alarm-act")) return;
  find("#alarm-news").hidden = true;
  toast(t("alarms.done"));
  renewAlarm(target).catch((error) => showError(error, null));
});
page.addEventListener("refused", async ({ target, detail }) => {
  if (detail.status !== 409 || !target.closest("#alarm-act")) return;
  acceptRevision(target);
  await renewQuietly();
  const news = find("#alarm-news");
  setText(news, t("alarms.conflict"));
  news.hidden = false;
});
page.addEventListener("click", (event) => {
  if (event.target.closest("[data-print]")) print();
});
feed.on("alarm", (data) => {
  if (String(data.id) === alarm) renewQuietly();
});
feed.on("snapshot", renewQuietly);
startShelveForm(find("#alarm-act"));
startDiagnosis();
