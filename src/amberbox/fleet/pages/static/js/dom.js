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
export function setText(element, said) {
  const text = visible(String(said ?? ""));
  const first = element?.firstChild;
  if (first && first === element.lastChild && first.nodeType === Node.TEXT_NODE) {
    if (first.data !== text) first.data = text;
  } else if (element && element.textContent !== text) element.textContent = text;
}

/** Set an attribute that is read: written out as all text is, and only if it is another one. */
export function setWords(element, name, said) {
  const text = visible(String(said ?? ""));
  if (element && element.getAttribute(name) !== text) element.setAttribute(name, text);
}

/** Attributes that people read or hear. */
const WORDS = new Set(["title", "alt", "placeholder", "label", "aria-label", "aria-description", "aria-valuetext", "data-label"]);

const HIDDEN = /[\u0000-\u0008\u000b-\u001f\u007f-\u009f\u00ad\u061c\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb]/g;

/** Write out what a text hides: controls, marks that reorder it, what has no width. */
export function visible(text) {
  const joins = (one, at) => (one === "\u200c" || one === "\u200d") && at > 0 && text.charCodeAt(at - 1) > 127;
  return text.replace(HIDDEN, (one, at) => (joins(one, at) ? one : `\\u${one.charCodeAt(0).toString(16).padStart(4, "0")}`));
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
    else if (WORDS.has(name)) setWords(element, name, value);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
  const there = inside.filter((one) => one !== null && one !== undefined);
  element.append(...there.map((one) => (typeof one === "string" ? visible(one) : one)));
  return element;
}

function sprite() {
  return new URL("icons.svg", import.meta.url).pathname;
}
