// A person's signing key in this browser: made here, it cannot be exported, and no server gets it.

import { toBase64, toHex } from "./command_bytes.js";

const DATABASE = "amberbox";
const STORE = "signing-keys";
const ED25519 = { name: "Ed25519" };

/** Return why this browser cannot sign, `insecure` or `old`; "" where it can. */
export async function obstacle() {
  if (!isSecureContext || !globalThis.crypto?.subtle) return "insecure";
  if (!globalThis.indexedDB) return "old";
  try {
    await crypto.subtle.generateKey(ED25519, false, ["sign", "verify"]);
    return "";
  } catch {
    return "old";
  }
}

/** Make and store the key of a person; one that is there stays. @param {string} person */
export async function makeKey(person) {
  const known = await loadKey(person);
  if (known) return known;
  const { privateKey, publicKey } = await crypto.subtle.generateKey(ED25519, false, ["sign", "verify"]);
  const bytes = new Uint8Array(await crypto.subtle.exportKey("raw", publicKey));
  await inStore("readwrite", (store) => store.add({ person, privateKey, bytes, made: new Date().toISOString() }));
  return loadKey(person);
}

/**
 * Return the key of a person in this browser; null without one.
 * @param {string} person
 * @returns {Promise<{id: string, text: string, made: string, sign: (bytes: Uint8Array) => Promise<string>} | null>}
 */
export async function loadKey(person) {
  const found = await inStore("readonly", (store) => store.get(person));
  if (!found) return null;
  const digest = new Uint8Array(await crypto.subtle.digest("SHA-256", found.bytes));
  return {
    id: toHex(digest).slice(0, 16),
    text: `ed25519:${toBase64(found.bytes)}`,
    made: found.made,
    sign: async (bytes) => toBase64(new Uint8Array(await crypto.subtle.sign(ED25519, found.privateKey, bytes))),
  };
}

/** Delete the key of a person from this browser. @param {string} person */
export const forgetKey = (person) => inStore("readwrite", (store) => store.delete(person));

/** Do something with the store of keys; resolves when it is durable. @param {(store: IDBObjectStore) => IDBRequest} work */
async function inStore(mode, work) {
  const database = await opened();
  try {
    return await new Promise((resolve, reject) => {
      const transaction = database.transaction(STORE, mode);
      const request = work(transaction.objectStore(STORE));
      transaction.oncomplete = () => resolve(request.result);
      transaction.onabort = () => reject(transaction.error);
    });
  } finally {
    database.close();
  }
}

function opened() {
  return new Promise((resolve, reject) => {
    const request = indexedDB.open(DATABASE, 1);
    request.onupgradeneeded = () => request.result.createObjectStore(STORE, { keyPath: "person" });
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
}
