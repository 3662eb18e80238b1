// One alarm: its parts follow what happens; what one is writing stays.

import { fail, toast } from "../ask.js";
import * as forms from "./forms.js";
import { keep as keepCard } from "../diagnosis/card.js";
import { one, setText } from "../dom.js";
import { listen } from "../feed.js";
import { piece, put } from "../pieces.js";
import { t } from "../strings.js";

const PARTS = ["alarm-head", "alarm-later", "alarm-links", "alarm-rest"];
const page = one("#alarm");
const { alarm, robot } = page.dataset;
const feed = listen({ kinds: ["alarm", "diagnosis"] });
let asked = 0;

/** Fetch the parts and put them in place; `mine` is the form that was sent just now. */
async function renew(mine = null) {
  const turn = (asked += 1);
  const fresh = await piece(`/pieces/alarms/${alarm}`);
  if (turn !== asked) return;
  const before = one("#alarm-head").dataset.revision;
  const act = forms.carried(one("#alarm-act"), one("#alarm-act", fresh), mine);
  for (const id of PARTS) put(one(`#${id}`), one(`#${id}`, fresh));
  forms.place(one("#alarm-act"), act);
  showDiagnosis(one("#alarm-diagnosis", fresh));
  if (!mine && one("#alarm-head").dataset.revision !== before) tellNews();
}

/** Say who changed what: the first line of the history. */
function tellNews() {
  const newest = one("#alarm-rest .alarm-history li");
  if (!newest) return;
  const what = one("strong", newest).textContent;
  const { who } = newest.dataset;
  const news = one("#alarm-news");
  setText(news, who ? t("alarms.changed", { who, what }) : t("alarms.changed_itself", { what }));
  news.hidden = false;
}

/** The diagnosis often comes after its alarm; when that is over it stays as it was last. */
function showDiagnosis(fresh) {
  const place = one("#alarm-diagnosis");
  if (["diagnosis", "kept"].every((key) => fresh.dataset[key] === place.dataset[key])) return;
  place.replaceWith(fresh);
  startDiagnosis();
}

/** Renew without a word if that fails: the feed tells again when it is back. */
function quietly() {
  return renew().catch(() => null);
}

function startDiagnosis() {
  const place = one("#alarm-diagnosis");
  const { diagnosis, kept } = place.dataset;
  if (!diagnosis) return;
  const query = new URLSearchParams({ diagnosis, ...(kept ? { revision: kept } : {}) });
  const path = () => `/robots/${encodeURIComponent(robot)}/diagnosis/card?${query}`;
  keepCard(place, { path, feed, robot, renewed: quietly });
}

page.addEventListener("done", ({ target }) => {
  if (!target.closest("#alarm-act")) return;
  one("#alarm-news").hidden = true;
  toast(t("alarms.done"));
  renew(target).catch((error) => fail(error, null));
});
page.addEventListener("refused", async ({ target, detail }) => {
  if (detail.status !== 409 || !target.closest("#alarm-act")) return;
  forms.forget(target);
  await quietly();
  const news = one("#alarm-news");
  setText(news, t("alarms.conflict"));
  news.hidden = false;
});
page.addEventListener("click", (event) => {
  if (event.target.closest("[data-print]")) print();
});
feed.on("alarm", (data) => {
  if (String(data.id) === alarm) quietly();
});
feed.on("snapshot", quietly);
forms.start(one("#alarm-act"));
startDiagnosis();
