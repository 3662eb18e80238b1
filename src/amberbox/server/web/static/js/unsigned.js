// What waits for a signature, of all robots: follows the feed.

import { followParts } from "./command_parts.js";

followParts(null, () => "/pieces/commands");
