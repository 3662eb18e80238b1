/** Names of variables: long ones break where their parts meet, and are never cut. */

import { el } from "./dom.js";

const PART = /[^_./]+[_./]*|[_./]+/g;

/** A name that may break behind `_`, `.` and `/`. @param {string} name @returns {(string|Node)[]} */
export function breakable(name) {
  return (name.match(PART) ?? []).flatMap((part, n) => (n ? [el("wbr"), part] : [part]));
}
