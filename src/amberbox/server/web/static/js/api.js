// Requests to the server, and messages about what went wrong.

import { el, icon } from "./dom.js";
import { t } from "./strings.js";

const TOAST_MS = 6000;

/** The server refused a request, or cannot be reached (status 0). */
export class ApiError extends Error {
  constructor(what, hint, status) {
    super(what);
    this.hint = hint;
    this.status = status;
  }
}

/**
 * Send a request and return the JSON of the answer, null for none. Throws ApiError.
 * @param {string} path
 * @param {{method?: string, body?: unknown, signal?: AbortSignal, keepalive?: boolean}} [options] `keepalive`: also when the page is closed
 */
export async function requestJson(path, options = {}) {
  const response = await request(path, options);
  return response.status === 204 ? null : response.json();
}

/** Request columns of numbers, in the format ABP1. Throws ApiError. @returns {Promise<{header: any, columns: Float64Array[]}>} */
export async function requestColumns(path, options = {}) {
  const buffer = await (await request(path, options)).arrayBuffer();
  return decodeColumns(buffer);
}

/** Decode the format ABP1: a header in JSON, then columns of 64-bit floats. @param {ArrayBuffer} buffer */
function decodeColumns(buffer) {
  const size = new DataView(buffer).getUint32(4, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, size)));
  const offset = Math.ceil((8 + size) / 8) * 8;
  const count = header.columns.length + 1;
  const rows = (buffer.byteLength - offset) / 8 / count;
  const columns = Array.from({ length: count }, (_, k) => new Float64Array(buffer, offset + k * rows * 8, rows));
  return { header, columns };
}

/** Show a short message that disappears by itself. @param {string} text @param {"ok"|"error"} kind */
export function toast(text, kind = "ok") {
  const message = el("div", { class: `toast ${kind}`, role: kind === "error" ? "alert" : "status" }, text);
  document.getElementById("toasts").append(message);
  setTimeout(() => message.remove(), TOAST_MS);
}

/** Show an error with its hint inside an element, until `clearError(place)`; without a place as a toast. */
export function showError(error, place) {
  clearError(place);
  if (!place) {
    toast(error.hint ? `${error.message} ${error.hint}` : error.message, "error");
    return;
  }
  const text = el("div", {}, el("strong", {}, error.message), error.hint ? el("p", {}, error.hint) : null);
  place.append(el("div", { class: "problem", role: "alert", "data-failed": true }, icon("error"), text));
}

/** Remove the error that `showError` put into an element. */
export function clearError(place) {
  place?.querySelector(":scope > [data-failed]")?.remove();
}

async function request(path, { method = "GET", body, signal, keepalive } = {}) {
  const headers = { Accept: "application/json" };
  if (method !== "GET") headers["X-CSRF-Token"] = document.querySelector('meta[name="csrf"]').content;
  if (body !== undefined) headers["Content-Type"] = "application/json";
  const response = await send(path, { method, headers, signal, keepalive, body: body === undefined ? undefined : JSON.stringify(body) });
  if (response.status === 401 && location.pathname !== "/sign-in") signIn();
  if (!response.ok) throw await errorOf(response);
  return response;
}

/** Call `fetch`; throws ApiError where the server cannot be reached. @param {RequestInit} init */
export async function send(path, init) {
  try {
    return await fetch(path, init);
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new ApiError(t("common.unreachable"), t("common.unreachable_hint"), 0);
  }
}

/**
 * Do something while a button is marked as busy, and show inside `place` what went wrong. Returns
 * the error, if any.
 * @param {Element | null} place @param {Element | null} button @param {() => Promise<void>} work
 */
export async function whileBusy(place, button, work) {
  clearError(place);
  button?.setAttribute("aria-busy", "true");
  try {
    await work();
  } catch (error) {
    showError(error, place);
    return error;
  } finally {
    button?.removeAttribute("aria-busy");
  }
  return null;
}

/** Return a function that aborts the request before, and returns the signal of the next one. */
export function latestSignal() {
  let controller = null;
  return () => {
    controller?.abort();
    controller = new AbortController();
    return controller.signal;
  };
}

/** Return the path of a robot in the API. @param {string} robot */
export const robotApi = (robot) => `/api/v1/robots/${encodeURIComponent(robot)}`;

/** Go to the page of signing in, which leads back here. */
export function signIn() {
  location.assign(`/sign-in?next=${encodeURIComponent(location.pathname + location.search)}`);
}

async function errorOf(response) {
  const answer = await response.json().catch(() => null);
  const { what = response.statusText, hint = "" } = answer?.error ?? {};
  return new ApiError(what, hint, response.status);
}
