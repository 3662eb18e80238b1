/** Which variables of a robot were looked at before, in this browser. */

const MOST = 8;
const key = (robot) => `variables of ${robot}`;

/** The names, the newest first; none where the browser keeps nothing. @returns {string[]} */
export function recent(robot) {
  try {
    const found = JSON.parse(localStorage.getItem(key(robot)) ?? "[]");
    return Array.isArray(found) ? found.filter((name) => typeof name === "string") : [];
  } catch {
    return []; // what is kept is only a help
  }
}

/** Remember names. @param {string} robot @param {string[]} names */
export function used(robot, names) {
  if (!names.length) return;
  const all = [...new Set([...names, ...recent(robot)])].slice(0, MOST);
  try {
    localStorage.setItem(key(robot), JSON.stringify(all));
  } catch {
    // a browser that keeps nothing shows nothing first
  }
}
