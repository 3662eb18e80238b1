// The state of a page in the parameters of its address: it can be sent to somebody, and "back" works.

/** Return a parameter of the address. @param {string} name @param {string} [fallback] */
export function getParam(name, fallback = "") {
  return new URLSearchParams(location.search).get(name) ?? fallback;
}

/** Return all values of a parameter. @param {string} name @returns {string[]} */
export function getParams(name) {
  return new URLSearchParams(location.search).getAll(name);
}

/**
 * Change parameters: "" and null remove one, a list gives it several values. `push` adds an entry
 * to the history, which "back" undoes.
 * @param {Record<string, string | number | boolean | string[] | null>} changes
 */
export function setParams(changes, { push = false } = {}) {
  const params = new URLSearchParams(location.search);
  for (const [name, value] of Object.entries(changes)) {
    params.delete(name);
    const values = Array.isArray(value) ? value : value === null || value === "" ? [] : [value];
    for (const item of values) params.append(name, String(item));
  }
  const query = params.toString();
  const address = location.pathname + (query ? `?${query}` : "") + location.hash;
  if (address === location.pathname + location.search + location.hash) return;
  history[push ? "pushState" : "replaceState"](null, "", address);
}

/** Listen to "back" and "forward". @param {() => void} changed */
export function onNavigation(changed) {
  addEventListener("popstate", changed);
}
