// What stands around the tree of a robot: graph, timeline, events, panels, what it is doing.

import { all, one } from "../dom.js";
import { keep, piece, put } from "../pieces.js";
import * as view from "../view.js";

const GRAPH_MS = 2000;
const TIMELINE_MS = 5000;

/**
 * Let one choose what is shown around the tree. Returns what asks for each part anew, by its name,
 * and `trend()`, which shows how the battery went.
 * @param {string} base where the robot's pieces are
 */
export function around(base) {
  const stale = {
    panels: keep(() => one("#panels"), () => `${base}/panels`, GRAPH_MS),
    graph: keep(() => one("#graph"), () => `${base}/graph`, GRAPH_MS),
    timeline: keep(() => one("#timeline"), timeline, TIMELINE_MS),
    events: keep(() => one("#events"), () => `${base}/events?${new URLSearchParams({ kind: view.get("kind") })}`),
    now: keep(() => one("#now"), () => `${base}/now`),
  };

  function timeline() {
    return `${base}/timeline?${new URLSearchParams({ window: view.get("window", "1h"), lanes: view.get("lanes") })}`;
  }

  async function change(changes) {
    view.set(changes);
    put(one("#timeline"), await piece(timeline()));
  }

  function chooseWindow(event) {
    const chip = event.target.closest("a[data-window]");
    if (!chip) return;
    event.preventDefault();
    for (const other of all("a[data-window]", event.currentTarget)) other.removeAttribute("aria-current");
    chip.setAttribute("aria-current", "true");
    change({ window: chip.dataset.window === "1h" ? null : chip.dataset.window });
  }

  function chooseLanes(event) {
    const isAll = event.currentTarget.getAttribute("aria-pressed") !== "true";
    event.currentTarget.setAttribute("aria-pressed", String(isAll));
    change({ lanes: isAll ? "all" : null });
  }

  /** Show how the battery went; it changes slowly. */
  async function trend() {
    if (!one("#trend")) return;
    const fresh = await piece(`${base}/battery`).catch(() => null); // the value itself is there without
    if (fresh) one("#trend")?.replaceWith(fresh);
  }

  showCause();
  new MutationObserver(showCause).observe(one("#graph").parentElement, { childList: true });
  one("#windows")?.addEventListener("click", chooseWindow);
  one("#lanes")?.addEventListener("click", chooseLanes);
  one("#event-kind")?.addEventListener("change", (event) => {
    view.set({ kind: event.target.value || null });
    stale.events();
  });
  return { ...stale, trend };
}

/** Where the graph is wider than its place, begin with what trouble comes from. */
function showCause() {
  const cause = one("#graph .node.root");
  const place = cause?.closest(".scroll");
  if (place) place.scrollLeft += cause.getBoundingClientRect().left - place.getBoundingClientRect().left - place.clientWidth / 4;
}
