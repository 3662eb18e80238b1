// Everything, or some of it: a box `data-type="every"` beside boxes of the same name. One of them has
// to be chosen; where everything is chosen there is nothing to choose from.

import { all } from "./dom.js";

/** Let such boxes of the page follow each other. */
export function start() {
  for (const every of all('[data-type="every"]')) {
    const some = [...every.form.elements].filter((one) => one.name === every.name && one !== every);
    const follow = () => {
      for (const one of some) one.disabled = every.checked;
      const isChosen = every.checked || some.some((one) => one.checked);
      every.setCustomValidity(isChosen ? "" : every.dataset.choose);
    };
    for (const one of [every, ...some]) one.addEventListener("change", follow);
    follow();
  }
}
