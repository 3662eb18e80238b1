// Making elements. Text from anywhere goes in as text, never as markup.

const SVG = "http://www.w3.org/2000/svg";

/**
 * Make an element. `about` are attributes; those that begin with `on` are listeners, `null` leaves
 * one out, `true` is one without a value.
 * @param {string} tag
 * @param {Record<string, any>} [about]
 * @param {...(Node | string | null | undefined)} inside
 */
export function el(tag, about = {}, ...inside) {
  return filled(document.createElement(tag), about, inside);
}

/** Make an element of SVG, in the same way. @param {string} tag */
export function svg(tag, about = {}, ...inside) {
  return filled(document.createElementNS(SVG, tag), about, inside);
}

/** Make a picture of the sprite, beside words. @param {string} name */
export function icon(name) {
  return svg("svg", { class: "icon", "aria-hidden": "true" }, svg("use", { href: `${sprite()}#${name}` }));
}

/** Make a level: picture, word and colour. @param {string} name @param {string} word */
export function level(name, word) {
  return el("span", { class: `level level-${name}`, "data-level": name }, icon(name), el("span", { class: "word" }, word));
}

/** Return the first element below `root` that fits. */
export const one = (selector, root = document) => root.querySelector(selector);

/** Return all elements below `root` that fit. @returns {HTMLElement[]} */
export const all = (selector, root = document) => [...root.querySelectorAll(selector)];

/**
 * Set a text only if it is another one: what has not changed is not drawn again. Where there is a
 * text and nothing else it is changed in its place, which costs the browser least.
 */
export function setText(element, text) {
  const first = element?.firstChild;
  if (first && first === element.lastChild && first.nodeType === Node.TEXT_NODE) {
    if (first.data !== text) first.data = text;
  } else if (element && element.textContent !== text) element.textContent = text;
}

/** Return what a page brought along for its modules. @param {string} id */
export function brought(id) {
  const element = document.getElementById(id);
  return element ? JSON.parse(element.textContent) : null;
}

function filled(element, about, inside) {
  for (const [name, value] of Object.entries(about)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
  element.append(...inside.filter((one) => one !== null && one !== undefined));
  return element;
}

function sprite() {
  return new URL("icons.svg", import.meta.url).pathname;
}
