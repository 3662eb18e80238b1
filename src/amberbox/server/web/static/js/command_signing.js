// Signing a command here: the robot is held for its run, by renewals, until the command has ended.

import { ApiError, requestJson, robotApi } from "./api.js";
import { loadKey, obstacle } from "./browser_key.js";
import { fromHex, signedBytes } from "./command_bytes.js";
import { setText } from "./dom.js";
import { t } from "./strings.js";

/** What in the session names the command that was ordered to be signed at once. */
export const SIGN_AT_ONCE = "amberbox-sign";
const RENEW_MS = 1000;
const POLL_MS = 500;
const TTL_S = 20;
const OPEN = ["unsigned", "waiting", "sent", "accepted"];

/**
 * Return the key of a person with which this browser can sign, and a text that says so, or why it
 * cannot.
 * @param {string} person
 */
export async function usableKey(person) {
  const why = await obstacle();
  if (why) return { key: null, text: t(`commands.${why}`) };
  const key = await loadKey(person);
  if (!key) return { key: null, text: t("commands.no_key") };
  const revoked = await requestJson("/api/v1/revoked-keys");
  if (revoked.some((one) => one.key_id === key.id)) return { key: null, text: t("commands.revoked", { id: key.id }) };
  return { key, text: t("commands.has_key", { id: key.id }) };
}

/** Show in an element what `usableKey` says. */
export function showKeyState(place, text) {
  if (!place) return;
  place.hidden = false;
  setText(place, text);
}

/**
 * Sign a command and hold its robot until it has ended; throws ApiError. `said` is called with what
 * is being done.
 * @param {{id: string, robot: string, run: string}} order as the page shows it
 * @param {{sign: (bytes: Uint8Array) => Promise<string>, id: string}} key
 * @param {(text: string) => void} said
 */
export async function signAndHold(order, key, said) {
  const api = robotApi(order.robot);
  said(t("commands.taking"));
  const { lease: present } = await requestJson(`${api}/actions`);
  if (present.holder && present.run === order.run) { // whoever runs it holds the robot
    await sign(api, order, key, present.number);
    said(t("commands.signing"));
    return;
  }
  const { number } = await requestJson(`${api}/lease`, { method: "POST", body: { run: order.run } });
  const renew = () => requestJson(`${api}/lease/renew`, { method: "POST", body: { number } });
  const renewing = setInterval(() => renew().catch((error) => said(t("commands.lease_lost", { why: error.message }))), RENEW_MS);
  const release = () => requestJson(`${api}/lease/release`, { method: "POST", body: { number }, keepalive: true }).catch(() => null); // it ends by itself
  const stay = (event) => event.preventDefault();
  addEventListener("beforeunload", stay);
  addEventListener("pagehide", release);
  try {
    await sign(api, order, key, number);
    said(t("commands.holding"));
    await untilEnd(`${api}/commands/${order.id}`);
  } finally {
    clearInterval(renewing);
    removeEventListener("beforeunload", stay);
    removeEventListener("pagehide", release);
    await release();
    said("");
  }
}

async function sign(api, order, key, lease) {
  const { challenge, server_id: server } = await requestJson(`${api}/actions`);
  if (!challenge) throw new ApiError(t("commands.no_challenge"), t("commands.no_challenge_hint"), 409);
  const covered = { server, lease, challenge: fromHex(challenge), ttlS: TTL_S };
  const body = { key_id: key.id, lease, challenge, ttl_s: TTL_S, server, signature: await key.sign(signedBytes(order, covered)) };
  await requestJson(`${api}/commands/${order.id}/sign`, { method: "POST", body });
}

async function untilEnd(path) {
  for (;;) {
    const line = await requestJson(path).catch(() => null); // the robot stops by itself while the server is away
    if (line && !OPEN.includes(line.state)) return;
    await new Promise((resolve) => setTimeout(resolve, POLL_MS));
  }
}
