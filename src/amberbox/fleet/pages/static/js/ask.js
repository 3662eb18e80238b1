// Asking the server, and saying what went wrong.

import { el, icon } from "./dom.js";
import { t } from "./strings.js";

const TOAST_MS = 6000;

/** What the server refused, or that it cannot be reached. */
export class AskError extends Error {
  constructor(what, hint, status) {
    super(what);
    this.hint = hint;
    this.status = status;
  }
}

/**
 * Ask the API; returns what the answer's JSON holds, null for none. Throws AskError.
 * @param {string} path
 * @param {{method?: string, body?: unknown, signal?: AbortSignal}} [how]
 */
export async function ask(path, how = {}) {
  const response = await fetched(path, how);
  return response.status === 204 ? null : response.json();
}

/** Ask for the numbers of a plot. @returns {Promise<{header: any, columns: Float64Array[]}>} */
export async function askPlot(path, how = {}) {
  const buffer = await (await fetched(path, how)).arrayBuffer();
  return unpacked(buffer);
}

/** Read the form ABP1: a header, then columns of numbers. @param {ArrayBuffer} buffer */
export function unpacked(buffer) {
  const size = new DataView(buffer).getUint32(4, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, size)));
  const begin = Math.ceil((8 + size) / 8) * 8;
  const number = header.columns.length + 1;
  const rows = (buffer.byteLength - begin) / 8 / number;
  const columns = Array.from({ length: number }, (_, k) => new Float64Array(buffer, begin + k * rows * 8, rows));
  return { header, columns };
}

/** Show a short message that goes by itself. @param {string} text @param {"ok"|"error"} kind */
export function toast(text, kind = "ok") {
  const shown = el("div", { class: `toast ${kind}`, role: kind === "error" ? "alert" : "status" }, text);
  document.getElementById("toasts").append(shown);
  setTimeout(() => shown.remove(), TOAST_MS);
}

/** Say beside an element what went wrong and what to do; `clear(near)` takes it away. */
export function fail(error, near) {
  clear(near);
  if (!near) {
    toast(error.hint ? `${error.message} ${error.hint}` : error.message, "error");
    return;
  }
  const words = el("div", {}, el("strong", {}, error.message), error.hint ? el("p", {}, error.hint) : null);
  near.append(el("div", { class: "problem", role: "alert", "data-failed": true }, icon("error"), words));
}

/** Take away what `fail` said. */
export function clear(near) {
  near?.querySelector(":scope > [data-failed]")?.remove();
}

async function fetched(path, { method = "GET", body, signal } = {}) {
  const headers = { Accept: "application/json" };
  if (method !== "GET") headers["X-CSRF-Token"] = document.querySelector('meta[name="csrf"]').content;
  if (body !== undefined) headers["Content-Type"] = "application/json";
  let response;
  try {
    response = await fetch(path, { method, headers, signal, body: body === undefined ? undefined : JSON.stringify(body) });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new AskError(t("common.unreachable"), t("common.unreachable_hint"), 0);
  }
  if (response.status === 401 && location.pathname !== "/sign-in") signIn();
  if (!response.ok) throw await refused(response);
  return response;
}

/** Go to sign in, and come back here. */
export function signIn() {
  location.assign(`/sign-in?next=${encodeURIComponent(location.pathname + location.search)}`);
}

async function refused(response) {
  const said = await response.json().catch(() => null);
  const { what = response.statusText, hint = "" } = said?.error ?? {};
  return new AskError(what, hint, response.status);
}
