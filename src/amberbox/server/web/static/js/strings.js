// Texts of the interface, from the catalogue that came with the page.

const texts = JSON.parse(document.getElementById("strings")?.textContent ?? "{}");

/**
 * Return a text with its fields filled in; its name if the catalogue lacks it.
 * @param {string} name
 * @param {Record<string, unknown>} [fields]
 */
export function t(name, fields = {}) {
  const text = texts[name] ?? name;
  return text.replace(/\{(\w+)\}/g, (whole, field) => (field in fields ? String(fields[field]) : whole));
}

/** Tell whether the catalogue has a text. @param {string} name */
export const hasText = (name) => name in texts;
