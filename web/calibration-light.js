// Whether the calibration held during a session, as the workers found it: a light with its meaning in words.

import { $, make, text } from "./elements.js";
import { node } from "./node-client.js";
import { nodes } from "./told.js";
import { t, wordOf } from "./words.js";

/** The last answer of each node's worker, by node. */
const lights = new Map();

/** Asks the workers of all nodes. */
export async function refreshLights() {
  await Promise.all(nodes().map(async ({ name, peer, status }) => {
    if (status) await node.calibrationLights(peer).then((told) => lights.set(name, { ...told, peer }), () => {});
  }));
  const kept = [...lights.values()].find(({ sessions }) => sessions.some(({ session_id }) => session_id));
  $("calibration-plot").hidden = !kept;
  if (kept) $("calibration-plot").href = node.calibrationPlot(kept.peer);
}

/** {light, word, said} of a session, which has the id that its recordings share. */
export function lightOf(name, id) {
  const told = [...lights.values()];
  const all = told.flatMap(({ sessions }) => sessions);
  const found = all.find((one) => id && one.session_id === id) ?? all.find((one) => !one.session_id && one.session === name);
  const unknown = { light: "grey", said: (told.find(({ worker }) => worker) ?? told[0])?.otherwise ?? t("light-no-node") };
  const { light, said } = found ?? unknown;
  return { light, word: wordOf("light", light), said };
}

/** Shows a light: a sign of another shape for each, the word, and the sentence behind it. */
export function showLight(element, { name, light: { light, word, said } }) {
  element.className = `light ${light}`;
  element.title = said;
  text(element, t("light-of", { name, said: said.startsWith(word) ? said : `${word} (${said})` }));
}

/** The same in a list, where the sentence stands only where something is wrong. */
export function lamp({ light, word, said }) {
  const wrong = light === "amber" || light === "red";
  return make("p", { className: `light ${light}`, title: said, textContent: t("light-in-list", { said: wrong ? `${word} (${said})` : word }) });
}
