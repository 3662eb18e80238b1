// Whether a value is as expected, as expected.py tells: by what the monitor writes of it.

/** @type {Record<string, (value: unknown, expected: unknown) => boolean>} */
const COMPARE = {
  "!=": (value, expected) => value !== expected,
  ">=": (value, expected) => value >= expected,
  "<=": (value, expected) => value <= expected,
  ">": (value, expected) => value > expected,
  "<": (value, expected) => value < expected,
};

/** Tell whether a value is as expected; also where nothing is. @param {string} expected @param {unknown} value */
export function isMet(expected, value) {
  if (!expected || value === null || value === undefined) return true;
  const isNumber = typeof value === "number";
  const ends = expected.split(" to ");
  if (isNumber && ends.length === 2) return Number(ends[0]) <= value && value <= Number(ends[1]);
  const [, relation, rest] = /^(\S+) (.+)$/s.exec(expected) ?? [];
  const compare = COMPARE[relation] ?? ((one, other) => one === other);
  const wanted = relation in COMPARE ? rest : expected;
  return compare(isNumber ? value : String(value), isNumber ? Number(wanted) : wanted);
}
