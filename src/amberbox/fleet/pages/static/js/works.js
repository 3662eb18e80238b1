/**
 * What is under way for the viewer: downloads that the server makes, windows that a robot is asked
 * for. Each is a line that follows how far it is, until it is taken away.
 */

import { ask, fail } from "./ask.js";
import { el, icon } from "./dom.js";
import { t } from "./strings.js";

const EVERY_MS = 2000;
const DOWNLOAD_OVER = ["done", "failed", "cancelled", "expired"];
const FETCH_OVER = ["ready", "gone", "cancelled"];

/**
 * Show lines inside a list. @param {HTMLElement} list @param {string} robot
 * @param {{fetched: function(): void}} about `fetched`: a window has come from the robot
 */
export function works(list, robot, { fetched }) {
  const lines = new Map();

  function line(path, about, write, over, ended) {
    const known = lines.get(about.id) ?? { root: el("li", { class: "work", "data-work": about.id }), path, write, over, ended };
    if (!lines.has(about.id)) list.append(known.root);
    lines.set(about.id, known);
    list.hidden = false;
    show(known, about);
  }

  function show(known, about) {
    known.state = about.state;
    const isOver = known.over.includes(about.state);
    const button = el("button", { class: "button quiet small", type: "button", onclick: () => leave(known, about.id, isOver) },
      t(isOver ? "data.works.close" : "data.works.stop"));
    const text = el("span", { role: "status" }, ...known.write(about));
    known.root.replaceChildren(icon(isOver ? "check" : "time"), text, button);
    if (!isOver) return;
    known.ended?.(about);
  }

  async function look(id) {
    const known = lines.get(id);
    if (!known || known.over.includes(known.state)) return;
    const about = await ask(known.path).catch(() => null); // asked again in a moment
    if (about && lines.has(id)) show(known, about);
  }

  async function leave(known, id, isOver) {
    try {
      if (!isOver) await ask(known.path, { method: "DELETE" });
    } catch (error) {
      fail(error, known.root);
      return;
    }
    known.root.remove();
    lines.delete(id);
    list.hidden = lines.size === 0;
  }

  setInterval(() => [...lines.keys()].forEach(look), EVERY_MS);
  return {
    /** Follow a download. @param {any} about as the server told it */
    download: (about) => line(`/api/v1/downloads/${about.id}`, about, writeDownload, DOWNLOAD_OVER),
    /** Follow a window that the robot was asked for. */
    fetch: (about) => line(`/api/v1/robots/${encodeURIComponent(robot)}/fetches/${about.id}`, about, writeFetch, FETCH_OVER,
      ({ state }) => state === "ready" && fetched()),
    /** The feed has told of a download. @param {string} id */
    look,
    isAsking: () => [...lines.values()].some((one) => one.over === FETCH_OVER && !one.over.includes(one.state)),
  };
}

function writeDownload(about) {
  const name = about.missions.length ? t("data.works.missions", { n: about.missions.length }) : t("data.works.view");
  const words = t(`data.works.download.${about.state}`, { name: `${name} (${about.format})` });
  if (about.state === "done") {
    return [`${words} `, el("a", { href: `/api/v1/downloads/${about.id}/file`, download: about.file ?? "" }, about.file ?? t("data.works.file"))];
  }
  if (about.state === "failed") return [words, " ", about.error];
  if (DOWNLOAD_OVER.includes(about.state)) return [words];
  const bar = el("progress", { max: 1, value: about.progress, "aria-label": words });
  return [words, " ", bar];
}

function writeFetch(about) {
  const words = t(`data.works.fetch.${about.state}`, { copied: about.copied, n: about.journals.length });
  return [words];
}
