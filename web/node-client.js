// What the console asks of the node that served it. Other nodes are reached through it, below /api/v1/peers/NAME.

import { t } from "./words.js";

// Relative to the page: a proxy may serve the node below a path of its own.
const API = "api/v1";

/** The node refused a request: `status` is HTTP's, `message` says what was expected. */
export class Refused extends Error {
  constructor(status, message) {
    super(message);
    this.status = status;
  }
}

/** The node does not answer at all. */
export class Gone extends Error {}

async function ask(path, options = {}, patience_ms = 4000) {
  let answer;
  try {
    answer = await fetch(API + path, { cache: "no-store", signal: AbortSignal.timeout(patience_ms), ...options });
  } catch {
    throw new Gone(t("no-answer"));
  }
  if (!answer.ok) {
    const fault = await answer.json().catch(() => ({}));
    throw new Refused(answer.status, fault.message ?? t("answered", { status: answer.status }));
  }
  return answer;
}

const get = (path) => ask(path).then((answer) => answer.json());
const post = (path, body, patience_ms) =>
  ask(path, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body ?? {}) }, patience_ms);

/** Path of what node `peer` tells; the empty name is the node that served this page. */
const at = (peer, path) => (peer ? `/peers/${encodeURIComponent(peer)}${path}` : path);
const frameSets = (peer, session) => at(peer, `/sessions/${encodeURIComponent(session)}/frame-sets`);
/** A node makes frame sets when nobody else wants its processors. */
const PLAY_PATIENCE_MS = 70000;
const look = (peer, session) => at(peer, `/sessions/${encodeURIComponent(session)}/quick-look`);

export const node = {
  login: (token) => post("/login", { token }),
  loginByLink: (code) => post("/login/link", { code }),
  logout: () => post("/logout"),
  identity: () => get("/identity"),
  status: () => get("/status"),
  peers: () => get("/peers"),
  capture: () => get("/capture"),
  begin: (series) => post("/capture", series),
  /** Somebody looks: cameras run without recording, until two seconds after the last call. */
  preview: () => post("/preview"),
  record: () => post("/capture/record"),
  stop: () => post("/capture/stop"),
  abort: (reason) => post("/capture/abort", { reason }),
  /** The next frame set of the live body after this number, with when its answer began; null where there is none yet. */
  live: async (after) => {
    const answer = await ask(`/live?after=${after}`);
    const at = performance.now();
    if (answer.status === 204) return null;
    return { facts: JSON.parse(answer.headers.get("x-live")), at, points: await answer.arrayBuffer() };
  },
  previews: (peer) => get(at(peer, "/previews")),
  /** A blob, or null before the first picture. */
  picture: (peer, camera) =>
    ask(at(peer, `/previews/${encodeURIComponent(camera)}`)).then((answer) => (answer.status === 204 ? null : answer.blob())),
  /** What its light is good for, to lie over it. */
  light: (peer, camera) =>
    ask(at(peer, `/previews/${encodeURIComponent(camera)}?light=true`)).then((answer) => (answer.status === 204 ? null : answer.blob())),
  /** A square of it in full size about a place, as parts of its width and height. */
  detail: (peer, camera, [x, y]) =>
    ask(at(peer, `/previews/${encodeURIComponent(camera)}?x=${x}&y=${y}`)).then((answer) => (answer.status === 204 ? null : answer.blob())),
  sessions: (peer, limit, search) => get(at(peer, `/sessions?limit=${limit}&search=${encodeURIComponent(search)}`)),
  remark: (peer, session, remark) => post(at(peer, `/sessions/${encodeURIComponent(session)}/remark`), remark),
  expose: (peer, request) => post(at(peer, "/exposure"), request, 40000).then((answer) => answer.json()),
  calibrationPlot: (peer) => API + at(peer, "/calibration-lights/plot"),
  calibrationLights: (peer) => get(at(peer, "/calibration-lights")),
  playable: (peer) => get(at(peer, "/playable")),
  /** What a player must know of a session; a frame set is packed points. Nobody else wants the time in which they are made. */
  frameSets: (peer, session) => ask(frameSets(peer, session), {}, PLAY_PATIENCE_MS).then((answer) => answer.json()),
  frameSet: (peer, session, trigger, signal) =>
    ask(`${frameSets(peer, session)}/${trigger}`, { signal: AbortSignal.any([signal, AbortSignal.timeout(PLAY_PATIENCE_MS)]) }).then((answer) => answer.arrayBuffer()),
  look: (peer, session) => get(look(peer, session)),
  askLook: (peer, session) => post(look(peer, session)),
  cloud: (peer, session, trigger) => ask(`${look(peer, session)}/${trigger}`, {}, 20000).then((answer) => answer.arrayBuffer()),
};
