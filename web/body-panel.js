// The place of the body: the live one, or the take that has just ended; its views, and its keys.

import { $, make } from "./elements.js";

/** From where the body is seen: azimuth from the rig's +x, and height, rad. Right and left are the subject's. */
const VIEWS = [["front", 0, 0.05], ["left", Math.PI / 2, 0.05], ["right", -Math.PI / 2, 0.05], ["top", 0, 1.5]];

/** The views by what they show: `live` and `take`. */
const views = new Map();

/** Adds a view with its turning, which `turns` stops and starts. */
export function addView(name, view, turns = () => {}) {
  views.set(name, { view, turns });
}

export const shown = () => $("body").dataset.shows;

/** Shows the live body or the take. */
export function showBody(name) {
  $("body").dataset.shows = name;
  for (const { view } of views.values()) view.draw();
}

const current = () => views.get(shown());

for (const [i, [name, azimuth, height]] of VIEWS.entries()) {
  const look = () => {
    current()?.turns(false);
    current()?.view.look(azimuth, height);
  };
  const button = make("button", { type: "button", onclick: look }, `${name} `, make("kbd", { textContent: String(i + 1) }));
  button.setAttribute("aria-keyshortcuts", String(i + 1));
  $("body-views").append(button);
}
const turn = make("button", { type: "button", onclick: () => current()?.turns(true) }, "turn ", make("kbd", { textContent: "5" }));
turn.setAttribute("aria-keyshortcuts", "5");
$("body-views").append(turn);

/** Does what a key stands for wherever the focus is; false: it stands for nothing here. */
export function bodyKey(key) {
  const button = $("body-views").children[Number(key) - 1];
  button?.click();
  return Boolean(button) || Boolean(current()?.view.key(key));
}
