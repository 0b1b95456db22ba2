// The cameras' tiles: what each sees, how good its light is, how old that is, and what is wrong.

import { $, make, span, text } from "./elements.js";
import { node } from "./node-client.js";
import { cameraProblem, lossOf, nodes } from "./told.js";

/** A picture that is older than this is not what the camera sees now. */
const LIVE_S = 2;
/** Advice by an older picture is of other light. */
const ADVICE_S = 60;
const FIGURES = [["saturated", "overexposed"], ["modulation", "stripes"], ["focus", "sharpness"], ["lost", "lost"]];
/** Contrast of the stripes in one word, by its grade. */
const STRIPES = { good: "good", fair: "fair", bad: "weak" };

const cameras = new Map();

function tile(id) {
  const picture = make("img", { alt: `what ${id} sees`, hidden: true });
  const empty = make("span", { textContent: "no picture yet" });
  const age = make("span", { className: "age" });
  const figures = Object.fromEntries(FIGURES.map(([key]) => [key, make("dd", { textContent: "–" })]));
  for (const key of ["saturated", "modulation", "focus"]) figures[key].classList.add("fades");
  const list = make("dl");
  const labels = Object.fromEntries(FIGURES.map(([key, label]) => [key, make("dt", { textContent: label })]));
  for (const [key] of FIGURES) list.append(make("div", {}, labels[key], figures[key]));
  const problem = make("p", { className: "said problem" });
  const advice = make("p", { className: "said advice", title: "opens exposure and gain (e)", onclick: () => $("exposure-open").click() });
  const box = make("figure", { className: "camera", id: `camera-${id}` },
    make("figcaption", { className: "title" }, make("span", { className: "name", textContent: id }), age),
    make("div", { className: "frame" }, empty, picture), list, problem, advice);
  return { box, picture, empty, age, figures, labels, problem, advice, number: 0, url: null, best: 0, fact: null, at: 0 };
}

/** How old a camera's picture is now, s; null where there is none. */
const ageOf = (shown) => (shown.fact?.number ? shown.fact.age_s + (performance.now() - shown.at) / 1000 : null);

/** How right the exposure of a camera is by its newest picture; null where that is old, or has no fringes. */
export function exposureOf(id) {
  const shown = cameras.get(id);
  return shown && ageOf(shown) !== null && ageOf(shown) < ADVICE_S ? (shown.fact.light?.exposure ?? null) : null;
}

/** Shows every camera of every node, those of a node that is gone as well. */
export function showTiles() {
  for (const from of nodes()) {
    for (const camera of from.last?.cameras ?? []) {
      if (!cameras.has(camera.id)) cameras.set(camera.id, tile(camera.id));
      showTile(cameras.get(camera.id), from, camera);
    }
  }
  // A column a head: the upper cameras above the lower ones.
  const order = (id) => (id.endsWith("_low") ? `1${id}` : `0${id}`);
  const ids = [...cameras.keys()].sort((a, b) => order(a).localeCompare(order(b)));
  if ($("tiles").childElementCount !== ids.length) $("tiles").replaceChildren(...ids.map((id) => cameras.get(id).box));
}

/** By how much to change the exposure; nothing where it is right. */
function exposureAdvice(exposure) {
  if (!exposure || (Math.abs(exposure.ev) < 0.3 && exposure.saturated < 0.005)) return "";
  const overexposed = exposure.saturated >= 0.005 ? `, ${(100 * exposure.saturated).toFixed(0)} % overexposed` : "";
  const advice = exposure.ev < 0 ? "too bright: darken" : "too dark: brighten";
  return `${advice} by ${Math.abs(exposure.ev).toFixed(1)} EV${overexposed}`;
}

function showTile(shown, from, camera) {
  const problem = cameraProblem(from, camera);
  const age = ageOf(shown);
  const live = !problem && age !== null && age < LIVE_S;
  shown.box.className = `camera ${problem ? "bad" : live ? "live" : ""} ${live ? "" : "old"}`;
  shown.box.dataset.trigger = shown.fact?.trigger ?? "";
  const old = age === null ? "" : live ? "live" : `${span(age)} old`;
  text(shown.age, problem && age === null ? "▲" : problem ? `▲ ${old === "live" ? span(age) : old}` : old);
  text(shown.problem, problem ?? "");
  shown.problem.title = problem ?? "";
  text(shown.advice, problem ? "" : exposureAdvice(shown.fact?.light?.exposure));
  const lost = lossOf(from.last, camera.id);
  const running = from.last.session && !from.last.session.outcome;
  grade(shown.figures.lost, running ? String(lost) : "–", lost ? "bad" : "");
}

export async function refreshPictures(peer) {
  for (const fact of await node.previews(peer)) {
    const shown = cameras.get(fact.camera);
    if (!shown) continue;
    shown.fact = fact;
    shown.at = performance.now();
    if (fact.light) showLight(shown, fact);
    if (!fact.number || fact.number === shown.number) continue;
    const blob = await node.picture(peer, fact.camera);
    if (!blob) continue;
    const url = URL.createObjectURL(blob);
    shown.picture.src = url;
    shown.picture.hidden = false;
    shown.empty.hidden = true;
    if (shown.url) URL.revokeObjectURL(shown.url);
    Object.assign(shown, { url, number: fact.number });
  }
}

function showLight(shown, { light, grades }) {
  const live = ageOf(shown) < LIVE_S;
  const kind = (key) => (live ? grades[key] : "");
  grade(shown.figures.saturated, `${(100 * light.saturated).toFixed(2)} %`, kind("saturated"));
  grade(shown.figures.modulation, STRIPES[grades.modulation], kind("modulation"));
  shown.figures.modulation.title = `amplitude of the stripes ${light.modulation_dn.toFixed(0)} of 255 grey values, contrast ${(100 * light.contrast).toFixed(0)} %`;
  if (live) shown.best = Math.max(shown.best, light.focus);
  // Sharpness has no right value: the best one so far stands beside it.
  text(shown.figures.focus, light.focus.toFixed(1));
  text(shown.labels.focus, shown.best ? `sharp, best ${shown.best.toFixed(1)}` : "sharpness");
}

function grade(element, value, kind) {
  text(element, value);
  for (const [name, is] of [["good", "good"], ["fair", "warn"], ["bad", "bad"]]) element.classList.toggle(is, kind === name);
}
