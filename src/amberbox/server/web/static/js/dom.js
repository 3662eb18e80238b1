// Elements of the page: making, finding and writing them. Text goes in as text, never as markup.

const SVG_NAMESPACE = "http://www.w3.org/2000/svg";

/**
 * Make an element. Attributes that begin with `on` are listeners, `null` leaves one out, `true`
 * gives one without a value; children that are `null` are left out.
 * @param {string} tag
 * @param {Record<string, any>} [attributes]
 * @param {...(Node | string | null | undefined)} children
 */
export function el(tag, attributes = {}, ...children) {
  return fill(document.createElement(tag), attributes, children);
}

/** Make an element of SVG, in the same way. @param {string} tag */
export function svg(tag, attributes = {}, ...children) {
  return fill(document.createElementNS(SVG_NAMESPACE, tag), attributes, children);
}

/** Make an icon, hidden from screen readers. @param {string} name its id in `icons.svg` */
export function icon(name) {
  return svg("svg", { class: "icon", "aria-hidden": "true" }, svg("use", { href: `${new URL("icons.svg", import.meta.url).pathname}#${name}` }));
}

/** Make the badge of a status level: icon, word and colour. @param {string} name @param {string} word */
export function levelBadge(name, word) {
  return el("span", { class: `level level-${name}`, "data-level": name }, icon(name), el("span", { class: "word" }, word));
}

/** Return the first element below `root` that matches. */
export const find = (selector, root = document) => root.querySelector(selector);

/** Return all elements below `root` that match. @returns {HTMLElement[]} */
export const findAll = (selector, root = document) => [...root.querySelectorAll(selector)];

/**
 * Set the text of an element if it differs. A single text node is changed in place, which costs
 * the browser less than a new one.
 */
export function setText(element, value) {
  const text = escapeHidden(String(value ?? ""));
  const first = element?.firstChild;
  if (first && first === element.lastChild && first.nodeType === Node.TEXT_NODE) {
    if (first.data !== text) first.data = text;
  } else if (element && element.textContent !== text) element.textContent = text;
}

/** Set an attribute that people read, with hidden characters escaped, if it differs. */
export function setTextAttribute(element, name, value) {
  const text = escapeHidden(String(value ?? ""));
  if (element && element.getAttribute(name) !== text) element.setAttribute(name, text);
}

// attributes that people read or hear
const TEXT_ATTRIBUTES = new Set(["title", "alt", "placeholder", "label", "aria-label", "aria-description", "aria-valuetext", "data-label"]);

const HIDDEN = /[\u0000-\u0008\u000b-\u001f\u007f-\u009f\u00ad\u061c\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb]/g;

/** Escape characters of a text that cannot be seen: controls, marks of direction, zero widths. */
export function escapeHidden(text) {
  const isJoiner = (char, at) => (char === "\u200c" || char === "\u200d") && at > 0 && text.charCodeAt(at - 1) > 127;
  return text.replace(HIDDEN, (char, at) => (isJoiner(char, at) ? char : `\\u${char.charCodeAt(0).toString(16).padStart(4, "0")}`));
}

/** Return the JSON that the page holds in an element. @param {string} id */
export function pageData(id) {
  const element = document.getElementById(id);
  return element ? JSON.parse(element.textContent) : null;
}

function fill(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (TEXT_ATTRIBUTES.has(name)) setTextAttribute(element, name, value);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
  const present = children.filter((child) => child !== null && child !== undefined);
  element.append(...present.map((child) => (typeof child === "string" ? escapeHidden(child) : child)));
  return element;
}

/** Return the parts of a name that may break behind `_`, `.` and `/`. @returns {(string|Node)[]} */
export function breakableName(name) {
  return (name.match(/[^_./]+[_./]*|[_./]+/g) ?? []).flatMap((part, n) => (n ? [el("wbr"), part] : [part]));
}
