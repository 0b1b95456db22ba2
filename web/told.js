// What the nodes told last, how old that is, and what follows from it. Everything that is shown comes from here.

import { span } from "./elements.js";
import { t, wordOf } from "./words.js";

/** What is older than this is grey, with its age: a node is busy with its devices, or the network is slow. */
export const LATE_S = 2;

/** A node that has not answered for so long is gone: nothing that came from it is current. */
export const GONE_S = 6;

const now = () => performance.now() / 1000;

/** For how long the node that served this page has not answered, s. */
export const silence_s = () => now() - told.at.status;

/** `at`: when each was told. `noBody`: why there is no live body and never will be. `last`: each node's last status, by name, with the time; it stays when the node is gone. */
export const told = { status: null, peers: [], capture: null, role: "view", noBody: null, at: { status: now(), peers: now(), capture: now() }, last: new Map() };

export function take(what, value) {
  told[what] = value;
  told.at[what] = now();
  if (what === "status") told.last.set(value.node, { status: value, at: now() });
  if (what === "peers") for (const { name, status } of value) if (status) told.last.set(name, { status, at: now() });
}

/** All nodes as {name, peer, status, last, age_s, problem}, this one first. `status` is null where there is no current
 * one; `last` is what was heard last. */
export function nodes() {
  const here = told.status ? [{ name: told.status.node, peer: "", status: told.status, problem: null }] : [];
  const others = told.peers.map((peer) => ({ name: peer.name, peer: peer.name, status: peer.status, problem: peer.problem }));
  return [...here, ...others].map((node) => {
    const heard = told.last.get(node.name);
    const unheard_s = heard ? now() - heard.at : Infinity;
    const gone = !node.status || unheard_s > GONE_S;
    return { ...node, status: gone ? null : node.status, last: heard?.status ?? null, age_s: heard ? heard.status.age_s + unheard_s : Infinity };
  });
}

export const sessionsUnderWay = () =>
  nodes().filter(({ status }) => status?.session && !status.session.outcome).map(({ status }) => status.session);

/** Whether a node runs its cameras only for those who look at the pictures. */
export const isInPreview = (status) => status.phase !== "idle" && status.preview != null && !status.preview.outcome;

/** Whether triggers are fired, for a session or for those who look at the pictures. */
export const camerasRun = () =>
  nodes().some(({ status }) => {
    const of = status && (isInPreview(status) ? status.preview : status.session);
    return of && !of.outcome && of.triggers > 0;
  });

/** How a node's session goes for a camera, while one is under way. */
const progressOf = (status, id) =>
  status?.session && !status.session.outcome ? status.session.cameras.find((camera) => camera.id === id) : null;

/** Whether a camera stays silent although triggers are fired. */
const isSilent = (status, id) => {
  const preview = isInPreview(status) ? status.preview.cameras.find((camera) => camera.id === id) : null;
  return (progressOf(status, id) ?? preview)?.silent;
};

/** Frames that a camera owes, as far as can be said now: gaps, and every trigger since which a silent one was not heard. */
export function lossOf(status, id) {
  const camera = progressOf(status, id);
  if (!camera) return 0;
  const owed = camera.silent ? Math.max(0, status.session.triggers - camera.frames - camera.gaps) : 0;
  return camera.gaps + owed;
}

/** What is wrong with a camera in one sentence; null where nothing is. A session notices within three triggers that a
 * camera is silent, its driver some seconds later. */
export function cameraProblem({ name, status, age_s }, camera) {
  if (!status) return Number.isFinite(age_s) ? t("camera-no-status-for", { node: name, seconds: Math.floor(age_s) }) : t("camera-no-status", { node: name });
  if (camera.problem) return camera.problem;
  return isSilent(status, camera.id) ? t("camera-silent") : null;
}

/** Everything that is wrong now, each in one sentence with its place; the same problem of several cameras is one sentence. */
export function problems() {
  const found = [];
  const cameras = new Map();
  for (const node of nodes()) {
    const { name, status, age_s } = node;
    if (!status) {
      found.push(Number.isFinite(age_s) ? t("problem-node-for", { node: name, seconds: Math.floor(age_s) }) : t("problem-node", { node: name }));
      continue;
    }
    if (age_s > GONE_S) found.push(t("problem-busy", { node: name, seconds: Math.floor(age_s) }));
    for (const camera of status.cameras) {
      const problem = cameraProblem(node, camera);
      if (!problem) continue;
      const words = problem.replace(`camera ${camera.id} `, "").replace(`camera ${camera.id}: `, "").replace(/^the camera /, "");
      cameras.set(words, [...(cameras.get(words) ?? []), camera.id]);
    }
    if (status.hsu.problem) found.push(t("problem-hsu", { node: name, problem: status.hsu.problem }));
  }
  const each = [...cameras].map(([problem, ids]) => t("problem-cameras", { n: ids.length, cameras: ids.join(", "), problem }));
  return [...each, ...found];
}

/** The disk that has no room for what is asked for, as a sentence; null where all have. `asked`: see form.js. */
function fullDisk(asked) {
  // Until Stop: a few seconds at least.
  const needed_s = asked.seconds === null ? 5 : asked.takes * (asked.seconds + asked.before + asked.after);
  for (const { name, seconds } of disks()) {
    if (seconds <= 0) return t("cannot-disk-full", { node: name });
    if (seconds >= needed_s) continue;
    return t("cannot-disk-room", { node: name, room: span(seconds), needed: span(needed_s) });
  }
  return null;
}

/** How much each disk can take, as {name, seconds, grade}. */
export const disks = () => nodes().flatMap(({ name, status }) => {
  const judged = status?.judgements.find((judgement) => judgement.name === "disk_time_left");
  return judged ? [{ name, seconds: judged.value, grade: judged.grade }] : [];
});

/** Why cameras cannot be started now; null when they can. */
export function cannotRun(asked) {
  if (silence_s() > GONE_S) return t("cannot-node", { node: told.status.node });
  const [first] = problems();
  if (first) return first;
  const known = nodes();
  const busy = known.find(({ status }) => status.phase !== "idle" && !isInPreview(status));
  if (busy) return t("cannot-phase", { node: busy.name, phase: wordOf("phase", busy.status.phase) });
  const absent = told.status.rig_nodes.filter((name) => !known.some((node) => node.name === name));
  if (absent.length && !asked.partial) return t("cannot-absent", { nodes: absent.join(", ") });
  return null;
}

/** Whether all devices of all nodes answer. One that is only silent under triggers does: its pictures are waited for. */
export const devicesAnswer = () =>
  nodes().every(({ status }) => status && !status.hsu.problem && status.cameras.every((camera) => !camera.problem));

/** Why nothing can be recorded now; null when Record would start. */
export const cannotRecord = (asked) => cannotRun(asked) ?? fullDisk(asked);
