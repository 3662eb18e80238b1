// Whether what robots say is worth a new look: a level, a state or who is in the way has changed.

/**
 * Return a function that takes statuses of a robot and tells whether one of them is news. Numbers
 * in reasons ("no scans for 3.2 s") count on all the time and are none.
 * @returns {(robot: string, statuses: any[]) => boolean}
 */
export function levels() {
  const known = new Map();
  return function news(robot, statuses) {
    let found = false;
    for (const one of statuses ?? []) {
      const key = JSON.stringify([robot, one.component, one.mode]);
      const now = JSON.stringify([one.level, one.state, one.blocked_by, one.reason.replace(/\d+([.,]\d+)?/g, "#")]);
      if (known.get(key) !== now) found = true;
      known.set(key, now);
    }
    return found;
  };
}
