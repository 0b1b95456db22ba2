// Quick looks at what was recorded: frame sets as clouds that turn under the mouse.

import { CloudView } from "./cloud-view.js";
import { $, make, text } from "./elements.js";
import { node } from "./node-client.js";
import { nodes } from "./told.js";

const view = new CloudView($("cloud-canvas"));
const look = { session: null, trigger: null, wanted: null };

/** Which of takes and quick look is shown where there is no room for both. */
export function showPanel(name) {
  $("panels").dataset.panel = name;
  for (const panel of ["sessions", "cloud"]) $(`tab-${panel}`).setAttribute("aria-selected", String(panel === name));
}
for (const panel of ["sessions", "cloud"]) $(`tab-${panel}`).addEventListener("click", () => showPanel(panel));

/** Asks all nodes for a look at a session; `forward` brings it to the front. */
export async function openLook(session, forward = false) {
  Object.assign(look, { session, trigger: null, wanted: session });
  text($("cloud-title"), `Quick look: ${session}`);
  text($("cloud-detail"), "");
  if (forward) showPanel("cloud");
  for (const { peer, status } of nodes()) if (status) await node.askLook(peer, session).catch((error) => text($("cloud-detail"), error.message));
  await refreshLook();
}

export async function refreshLook() {
  const session = look.wanted;
  if (!session) return;
  const states = [];
  for (const { name, peer, status } of nodes()) if (status) states.push({ name, peer, ...(await node.look(peer, session)) });
  const ready = states.filter((state) => state.triggers.length);
  const triggers = [...new Set(ready.flatMap((state) => state.triggers))].sort((a, b) => a - b);
  $("cloud-sets").replaceChildren(...triggers.map((trigger) => {
    const button = make("button", { type: "button", textContent: `trigger ${trigger}`, onclick: () => showCloud(ready, trigger) });
    button.setAttribute("aria-pressed", String(trigger === look.trigger));
    return button;
  }));
  const told = states.filter((state) => state.state !== "ready").map((state) => {
    if (state.state === "working") return `node ${state.name}: frame set ${state.done + 1} of ${state.of}`;
    if (state.state === "failed") return `node ${state.name}: ${state.reason}`;
    return `node ${state.name}: ${state.state.replaceAll("_", " ")}`;
  });
  if (told.length) text($("cloud-detail"), told.join("; "));
  const complete = states.length > 0 && states.every((state) => state.state === "ready");
  const first = triggers.find((trigger) => states.every((state) => state.triggers.includes(trigger)));
  if (look.trigger === null && first !== undefined) await showCloud(ready, first);
  if (complete) look.wanted = null;
}

async function showCloud(states, trigger) {
  const clouds = [];
  for (const state of states) if (state.triggers.includes(trigger)) clouds.push(await node.cloud(state.peer, look.session, trigger));
  const points = view.show(clouds);
  look.trigger = trigger;
  text($("cloud-detail"), view.works ? `trigger ${trigger}: ${points} points, from ${states.length} nodes` : "this browser has no WebGL 2; see fourdbody view");
  for (const button of $("cloud-sets").children) button.setAttribute("aria-pressed", String(button.textContent === `trigger ${trigger}`));
  $("cloud-canvas").dataset.points = String(points);
}
