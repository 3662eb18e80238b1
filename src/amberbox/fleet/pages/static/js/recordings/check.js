// Reading files anew: a few at a time, so that one sees how far it is and can stop it.

import { ask } from "../ask.js";
import { el, icon, setText } from "../dom.js";
import { t } from "../strings.js";

const STEP = 20;
const READ = ["intact", "unsigned", "altered"];

/**
 * Look at all files of a robot; returns the names of those that are altered.
 * @param {string} robot
 * @param {number} total
 * @param {HTMLElement} place where it says how far it is
 * @returns {Promise<string[]>}
 */
export async function check(robot, total, place) {
  const stop = new AbortController();
  const found = { looked: 0, read: 0, missing: 0, altered: [], isStopped: false };
  const show = progress(place, total, () => stop.abort());
  try {
    for await (const page of pages(robot, stop.signal)) {
      count(found, page);
      show(found.looked);
    }
  } catch (error) {
    if (error.name !== "AbortError") throw error;
    found.isStopped = true;
  }
  place.replaceChildren(...result(found, total));
  return found.altered;
}

async function* pages(robot, signal) {
  let after = "";
  for (;;) {
    const query = new URLSearchParams({ check: "true", limit: String(STEP), after });
    const page = await ask(`/api/v1/robots/${encodeURIComponent(robot)}/recordings?${query}`, { signal });
    yield page;
    if (page.length < STEP) return;
    after = nameOf(page.at(-1));
  }
}

const nameOf = (file) => `${file.store_id}/${file.journal}`;

function count(found, page) {
  found.looked += page.length;
  found.read += page.filter((one) => READ.includes(one.integrity)).length;
  found.missing += page.filter((one) => one.integrity === "missing").length;
  found.altered.push(...page.filter((one) => one.integrity === "altered").map(nameOf));
}

function progress(place, total, stop) {
  const bar = el("progress", { max: Math.max(total, 1), value: 0, "aria-label": t("recordings.check.at", { n: 0, all: total }) });
  const words = el("span", { class: "small muted", role: "status" });
  const button = el("button", { class: "button small", type: "button", onclick: stop }, t("recordings.check.stop"));
  place.replaceChildren(bar, el("div", { class: "spread" }, words, button));
  place.hidden = false;
  return (n) => {
    bar.value = n;
    setText(words, t("recordings.check.at", { n, all: total }));
  };
}

function result({ looked, read, missing, altered, isStopped }, total) {
  const bad = altered.length;
  const text = t(bad ? "recordings.check.bad" : "recordings.check.good", { n: read, bad });
  const gone = missing ? ` ${t("recordings.check.gone", { n: missing })}` : "";
  const stopped = isStopped ? ` ${t("recordings.check.stopped", { n: looked, all: total })}` : "";
  const list = el("ul", { class: "mono small" }, ...altered.map((name) => el("li", {}, name)));
  const kind = bad || missing ? "problem" : "notice";
  const head = el("div", { class: kind, role: "status" }, icon(bad || missing ? "error" : "check"), " ", text + gone + stopped);
  return bad ? [head, list] : [head];
}
