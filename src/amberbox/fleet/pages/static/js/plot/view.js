/**
 * The window of time that plots show, and where one was before. All are functions of windows.
 *
 * @typedef {{from: number, to: number}} Span seconds
 */

const LEAST_S = 1e-3;
const MOST_S = 100 * 366 * 86400;
const KEPT = 50;

/** Zoom by a factor about a time that stays where it is. @param {Span} view @returns {Span} */
export function zoomed(view, factor, about = (view.from + view.to) / 2) {
  const part = (about - view.from) / (view.to - view.from);
  const width = bounded((view.to - view.from) * factor);
  return { from: about - part * width, to: about + (1 - part) * width };
}

/** Move by a part of the window's width. @param {Span} view @param {number} part @returns {Span} */
export function panned(view, part) {
  const by = (view.to - view.from) * part;
  return { from: view.from + by, to: view.to + by };
}

/**
 * A window that is neither empty nor endless: of one that is too wide its end counts. Whoever keeps
 * a window beside the plots makes it sane first, so that both are the same.
 * @param {Span} view @returns {Span}
 */
export function sane({ from, to }) {
  const width = bounded(to - from);
  if (width === to - from) return { from, to };
  if (width < to - from) return { from: to - width, to };
  const middle = (from + to) / 2;
  return { from: middle - width / 2, to: middle + width / 2 };
}

/** Put a window onto those where one was before. @param {Span[]} back @param {Span} view */
export function remember(back, view) {
  back.push(view);
  if (back.length > KEPT) back.shift();
}

/** @param {Span} one @param {Span} other */
export const isSame = (one, other) => one.from === other.from && one.to === other.to;

function bounded(width) {
  return Math.min(Math.max(width, LEAST_S), MOST_S);
}
