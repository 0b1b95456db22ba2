// Quick looks at what was recorded: frame sets as clouds that turn under the mouse.

import { addView, showBody } from "./body-panel.js";
import { CloudView } from "./cloud-view.js";
import { $, make, text } from "./elements.js";
import { node } from "./node-client.js";
import { nodes } from "./told.js";
import { onLanguage, t, wordOf } from "./words.js";

const view = new CloudView($("cloud-canvas"));
const look = { session: null, trigger: null, wanted: null };

addView("take", view);

/** Asks all nodes for a look at a take, which stands in the place of the live body until somebody is done with it. */
export async function openLook(session) {
  Object.assign(look, { session, trigger: null, wanted: session });
  text($("cloud-title"), session);
  text($("cloud-detail"), t("cloud-asked"));
  view.show([]);
  $("cloud-canvas").dataset.points = "0";
  showBody("take");
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
    const button = make("button", { type: "button", textContent: t("cloud-trigger", { trigger: String(trigger) }), onclick: () => showCloud(ready, trigger) });
    button.dataset.trigger = String(trigger);
    button.setAttribute("aria-pressed", String(trigger === look.trigger));
    return button;
  }));
  const told = states.filter(({ state }) => state !== "ready" && state !== "not_asked").map((state) => {
    const said = state.state === "working" ? t("look-working", { number: state.done + 1, all: state.of }) : state.state === "failed" ? state.reason : wordOf("look", state.state);
    return t("node-says", { node: state.name, said });
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
  text($("cloud-detail"), view.works ? t("cloud-facts", { trigger: String(trigger), points, n: states.length }) : t("cloud-no-webgl"));
  for (const button of $("cloud-sets").children) button.setAttribute("aria-pressed", String(button.dataset.trigger === String(trigger)));
  $("cloud-canvas").dataset.points = String(points);
}

/** The take that is shown. */
export const lookedAt = () => look.session;
$("cloud-close").addEventListener("click", () => showBody("live"));
// What is said of it is said anew.
onLanguage(() => Object.assign(look, { trigger: null, wanted: look.session }));
