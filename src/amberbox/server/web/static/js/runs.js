// The list of runs follows the feed.

import { find } from "./dom.js";
import { subscribe } from "./feed.js";
import { throttledFragment } from "./fragments.js";

const refresh = throttledFragment(() => find("#run-list"), () => `/pieces/runs${location.search}`);
const feed = subscribe({ kinds: ["run"] });
feed.on("run", refresh);
feed.on("snapshot", refresh);
