// The bytes that a signature of a command covers: those of `signed_bytes` in core/command.py.

const DOMAIN = "amberbox-command-1\0";

/**
 * Return what is signed: the domain, then each field as a 4-byte big-endian length and its UTF-8 or
 * raw bytes. `challenge` are 32 bytes; the parameters are the text as it is.
 * @param {{id: string, robot: string, action: string, parameters: string, risk: string, run: string, step: string}} order
 * @param {{server: string, lease: number|bigint, challenge: Uint8Array, ttlS: number}} signature
 * @returns {Uint8Array}
 */
export function signedBytes(order, { server, lease, challenge, ttlS }) {
  if (typeof lease === "number" && !Number.isSafeInteger(lease)) throw new RangeError(`a lease of ${lease}`);
  const encoder = new TextEncoder();
  const texts = [order.id, order.robot, server, order.run, order.step, order.action, order.parameters, order.risk, String(lease)];
  const fields = [...texts.map((text) => encoder.encode(text)), challenge, encoder.encode(String(ttlS))];
  const parts = [encoder.encode(DOMAIN), ...fields.flatMap((field) => [bigEndian(field.length), field])];
  const all = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of parts) {
    all.set(part, at);
    at += part.length;
  }
  return all;
}

function bigEndian(number) {
  const bytes = new Uint8Array(4);
  new DataView(bytes.buffer).setUint32(0, number);
  return bytes;
}

/** @param {string} text @returns {Uint8Array} */
export const fromHex = (text) => Uint8Array.from(text.match(/../g) ?? [], (pair) => Number.parseInt(pair, 16));

/** @param {Uint8Array} bytes */
export const toHex = (bytes) => Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");

/** @param {Uint8Array} bytes */
export const toBase64 = (bytes) => btoa(String.fromCharCode(...bytes));
