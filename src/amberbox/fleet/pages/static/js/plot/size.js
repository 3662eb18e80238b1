/** How wide a stack of plots is, as its place on the page changes. */

const NARROW_PX = 620;

/** Draw anew with each other width. @param {any} stack @param {AbortSignal} signal */
export function watchSize(stack, signal) {
  const look = () => {
    const width = Math.floor(stack.frame.panels.clientWidth);
    if (width === stack.width) return;
    stack.width = width;
    stack.narrow = width < NARROW_PX;
    stack.redraw();
  };
  const watcher = new ResizeObserver(look);
  watcher.observe(stack.frame.panels);
  signal.addEventListener("abort", () => watcher.disconnect());
  look();
}

