// Which takes can be played: those that the worker of a node's machine has reconstructed.

import { make } from "./elements.js";
import { node } from "./node-client.js";
import { nodes } from "./told.js";
import { t } from "./words.js";

/** What each node told last, by node. */
const known = new Map();

/** Asks all nodes. */
export async function refreshPlayable() {
  await Promise.all(nodes().map(async ({ name, peer, status }) => {
    if (status) await node.playable(peer).then((told) => known.set(name, { ...told, peer }), () => {});
  }));
}

/** {peer} of the node that has a session's results, or {why}; null where no node knows of a worker. */
export function playableOf(name, id) {
  const told = [...known.values()].filter(({ worker }) => worker);
  if (!told.length) return null;
  const all = told.flatMap(({ peer, sessions }) => sessions.map((one) => ({ peer, ...one })));
  const found = all.find((one) => id && one.session_id === id) ?? all.find((one) => !one.session_id && one.session === name);
  if (!found) return { why: told[0].otherwise };
  return found.why_not ? { why: found.why_not } : { peer: found.peer };
}

/** The button of a take; none where there is no worker. */
export function playButton({ name, playable, word }) {
  if (!playable || word === "recording") return [];
  const { peer, why } = playable;
  const page = `play.html?session=${encodeURIComponent(name)}&node=${encodeURIComponent(peer ?? "")}`;
  const button = make("button", { type: "button", textContent: t("take-play"), disabled: Boolean(why), title: why ?? "", onclick: () => window.open(page, "_blank", "noopener") });
  button.setAttribute("aria-label", why ? t("take-play-not", { name, why }) : t("take-play-label", { name }));
  return [button];
}
