/** Colours of plots: those of the page's style, read again when light and dark change. */

const PLOTS = 8;
const NAMES = { ink: "--ink", ink2: "--ink-2", line: "--line", surface: "--surface", accent: "--accent",
  shade: "--shade", error: "--error", errorBg: "--error-bg", staleBg: "--stale-bg" };

/**
 * Read the colours that canvases draw with.
 * @param {HTMLElement} root
 * @returns {Record<string, string> & {plot: string[]}}
 */
export function colours(root) {
  const probe = document.createElement("span");
  probe.hidden = true;
  root.append(probe);
  const read = (name) => {
    probe.style.color = `var(${name})`;
    return getComputedStyle(probe).color;
  };
  const found = Object.fromEntries(Object.entries(NAMES).map(([key, name]) => [key, read(name)]));
  found.plot = Array.from({ length: PLOTS }, (_, n) => read(`--plot-${n + 1}`));
  probe.remove();
  return found;
}

/** Call when the theme changes, and before and after printing. @param {function(): void} fn */
export function onTheme(fn, signal) {
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  dark.addEventListener("change", fn, { signal });
  const watcher = new MutationObserver(fn);
  watcher.observe(document.documentElement, { attributeFilter: ["data-theme"] });
  signal.addEventListener("abort", () => watcher.disconnect());
  window.matchMedia("print").addEventListener("change", fn, { signal });
}
