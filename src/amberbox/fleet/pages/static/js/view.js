// The address is the view: what one sees can be sent to somebody, and comes back with "back".

/** Return a parameter of the address. @param {string} name @param {string} [otherwise] */
export function get(name, otherwise = "") {
  return new URLSearchParams(location.search).get(name) ?? otherwise;
}

/** Return all values of a parameter. @param {string} name @returns {string[]} */
export function list(name) {
  return new URLSearchParams(location.search).getAll(name);
}

/**
 * Change parameters: "" and null take one away, a list stands for several values. `push` makes a
 * step that "back" undoes.
 * @param {Record<string, string | number | boolean | string[] | null>} changes
 */
export function set(changes, { push = false } = {}) {
  const known = new URLSearchParams(location.search);
  for (const [name, value] of Object.entries(changes)) {
    known.delete(name);
    const values = Array.isArray(value) ? value : value === null || value === "" ? [] : [value];
    for (const one of values) known.append(name, String(one));
  }
  const query = known.toString();
  const address = location.pathname + (query ? `?${query}` : "") + location.hash;
  if (address === location.pathname + location.search + location.hash) return;
  history[push ? "pushState" : "replaceState"](null, "", address);
}

/** Listen to "back" and "forward". @param {() => void} changed */
export function on(changed) {
  addEventListener("popstate", changed);
}
