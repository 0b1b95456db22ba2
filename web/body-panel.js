// The place of the body: the live one, or the take that has just ended; its views, and its keys.

import { $, make } from "./elements.js";
import { onLanguage, wordOf } from "./words.js";

/** From where the body is seen: azimuth from the rig's +x, and height, rad. Right and left are the subject's. */
const VIEWS = [["front", 0, 0.05], ["left", Math.PI / 2, 0.05], ["right", -Math.PI / 2, 0.05], ["top", 0, 1.5]];

/** Time between two pictures while a body turns, ms: a node's own processor may have to draw them. */
const TICK_MS = 80;
/** One turn in half a minute, rad a tick. */
const TURN = (2 * Math.PI * TICK_MS) / 30000;
const still = matchMedia("(prefers-reduced-motion: reduce)");

/** The views by what they show: `live` and `take`; each turns until somebody turns it otherwise. */
const views = new Map();

/** Adds a view. */
export function addView(name, view) {
  views.set(name, { view, turns: true });
  for (const event of ["pointerdown", "keydown", "wheel"]) view.canvas.addEventListener(event, () => (views.get(name).turns = false));
}

setInterval(() => {
  const { view, turns } = current() ?? {};
  if (turns && view.points && !still.matches && !document.hidden) view.turn(TURN, 0);
}, TICK_MS);

export const shown = () => $("body").dataset.shows;

/** Shows the live body or the take, which turns again. */
export function showBody(name) {
  $("body").dataset.shows = name;
  current().turns = true;
  current().view.draw();
}

const current = () => views.get(shown());

/** Adds a button with its key. */
function addButton(name, key, onclick) {
  const word = make("span");
  onLanguage(() => (word.textContent = wordOf("view", name)));
  const button = make("button", { type: "button", onclick }, word, " ", make("kbd", { textContent: key }));
  button.setAttribute("aria-keyshortcuts", key);
  $("body-views").append(button);
}

for (const [i, [name, azimuth, height]] of VIEWS.entries()) {
  addButton(name, String(i + 1), () => {
    current().turns = false;
    current().view.look(azimuth, height);
  });
}
addButton("turn", "5", () => (current().turns = true));

/** Does what a key stands for wherever the focus is; false: it stands for nothing here. */
export function bodyKey(key) {
  const button = $("body-views").children[Number(key) - 1];
  button?.click();
  if (button) return true;
  const turned = current().view.key(key);
  if (turned) current().turns = false;
  return turned;
}
