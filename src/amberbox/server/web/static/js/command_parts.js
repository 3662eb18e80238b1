// Parts of pages about commands, each fetched again and replaced alone when commands change.

import { find } from "./dom.js";
import { subscribe } from "./feed.js";
import { fetchNodes, replaceElement } from "./fragments.js";

const PAUSE_MS = 300;

/**
 * Keep the parts of a page current; `placed` is called after each time.
 * @param {string[] | null} robots null: all
 * @param {() => string} address
 * @param {() => void} [placed]
 */
export function followParts(robots, address, placed = () => {}) {
  let isLoading = false;
  let isRequested = false;

  async function refresh() {
    isRequested = true;
    if (isLoading) return;
    isLoading = true;
    while (isRequested) {
      isRequested = false;
      const nodes = await fetchNodes(address()).catch(() => []); // the feed tells when the server is back
      for (const fresh of nodes.filter((node) => node.id)) {
        const old = find(`#${CSS.escape(fresh.id)}`);
        if (old) replaceElement(old, document.adoptNode(fresh));
      }
      placed();
      await new Promise((resolve) => setTimeout(resolve, PAUSE_MS));
    }
    isLoading = false;
  }

  const feed = subscribe({ robots, kinds: ["command", "presence"] });
  for (const kind of ["command", "presence", "snapshot"]) feed.on(kind, refresh);
  return refresh;
}
