/**
 * What is under way for the viewer: downloads that the server makes, windows that a robot is asked
 * for. Each is a line that follows how far it is, until it is taken away.
 */

import { ask, fail } from "./ask.js";
import { el, icon, setText, setWords } from "./dom.js";
import { t } from "./strings.js";

const AGAIN_MS = 5000;
const DOWNLOAD_OVER = ["done", "failed", "cancelled", "expired"];
const FETCH_OVER = ["ready", "gone", "cancelled"];

/**
 * Show lines inside a list. @param {HTMLElement} list @param {string} robot
 * @param {{fetched: function(): void}} about `fetched`: a window has come from the robot
 */
export function works(list, robot, { fetched }) {
  const lines = new Map();

  function line(path, about, write, over, ended) {
    const known = lines.get(about.id) ?? { ...made(about.id, leave), path, write, over, ended };
    if (!lines.has(about.id)) list.append(known.root);
    lines.set(about.id, known);
    list.hidden = false;
    show(known, about);
  }

  /** Change what has changed and nothing else: the button keeps the focus, no text is said twice. */
  function show(known, about) {
    known.state = about.state;
    const { text, progress = null, link = null } = known.write(about);
    setText(known.text, text);
    known.bar.hidden = progress === null;
    known.bar.value = progress ?? 0;
    setWords(known.bar, "aria-label", text);
    if (!isOver(known)) return;
    known.picture.replaceChildren(icon("check"));
    if (link && !known.text.nextElementSibling.matches("a")) known.text.after(link);
    setText(known.button, t("data.works.close"));
    known.ended?.(about);
  }

  const isOver = (known) => known.over.includes(known.state);

  async function look(id) {
    const known = lines.get(id);
    if (!known || isOver(known)) return;
    const about = await ask(known.path).catch(() => null);
    if (!about) setTimeout(look, AGAIN_MS, id);
    else if (lines.has(id)) show(known, about);
  }

  async function leave(id) {
    const known = lines.get(id);
    try {
      if (!isOver(known)) await ask(known.path, { method: "DELETE" });
    } catch (error) {
      fail(error, known.root);
      return;
    }
    known.root.remove();
    lines.delete(id);
    list.hidden = lines.size === 0;
  }

  return {
    /** Follow a download. @param {any} about as the server told it */
    download: (about) => line(`/api/v1/downloads/${about.id}`, about, writeDownload, DOWNLOAD_OVER),
    /** Follow a window that the robot was asked for. */
    fetch: (about) => line(`/api/v1/robots/${encodeURIComponent(robot)}/fetches/${about.id}`, about, writeFetch, FETCH_OVER,
      ({ state }) => state === "ready" && fetched()),
    /** The feed has told of a download or a window. @param {string} id */
    look,
    /** Something may have been missed. */
    lookAll: () => [...lines.keys()].forEach(look),
    isAsking: () => [...lines.values()].some((one) => one.over === FETCH_OVER && !isOver(one)),
  };
}

/** Make the parts of a line. @param {string} id @param {function(string): void} leave */
function made(id, leave) {
  const picture = el("span", {}, icon("time"));
  const text = el("span", { class: "work-text", role: "status" });
  const bar = el("progress", { max: 1 });
  const button = el("button", { class: "button quiet small", type: "button", onclick: () => leave(id) }, t("data.works.stop"));
  return { root: el("li", { class: "work", "data-work": id }, picture, text, bar, button), picture, text, bar, button };
}

/** What a line says: `progress` from 0 to 1 while it is being made, `link` to what was made. */
function writeDownload(about) {
  const name = about.missions.length ? t("data.works.missions", { n: about.missions.length }) : t("data.works.view");
  const words = t(`data.works.download.${about.state}`, { name: `${name} (${about.format})` });
  if (about.state === "done") {
    return { text: words, link: el("a", { href: `/api/v1/downloads/${about.id}/file`, download: about.file ?? "" }, about.file ?? t("data.works.file")) };
  }
  if (about.state === "failed") return { text: `${words} ${about.error}` };
  return { text: words, progress: DOWNLOAD_OVER.includes(about.state) ? null : about.progress };
}

function writeFetch(about) {
  return { text: t(`data.works.fetch.${about.state}`, { copied: about.copied, n: about.journals.length }) + (about.reason ? ` ${about.reason}` : "") };
}
