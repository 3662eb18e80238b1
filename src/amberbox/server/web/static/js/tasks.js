// The step that is to be done now; the next one appears by itself.

import { find } from "./dom.js";
import { keepRunCurrent } from "./run_parts.js";

const page = find("#tasks");
const parts = () => find("#task-parts").dataset;
let shown = parts().run;

// who does the steps of a run stays with it, also when it is over, to see how it has ended
const { bePresent } = keepRunCurrent("task-parts", {
  address: () => `/pieces/tasks?run=${encodeURIComponent(page.dataset.wanted || shown)}`,
  robots: null, run: () => parts().run, robot: () => parts().robot, role: () => "operator",
  placed: () => {
    const { run } = parts();
    if (!run || run === shown) return;
    shown = run;
    bePresent();
  },
});
