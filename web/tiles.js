// The cameras' tiles: what each sees, whether it is good in one sign, how old it is, and what is wrong.

import { $, make, span, text } from "./elements.js";
import { node } from "./node-client.js";
import { cameraProblem, lossOf, nodes, told } from "./told.js";
import { number, onLanguage, t, wordOf } from "./words.js";

/** A picture that is older than this is not what the camera sees now. */
const LIVE_S = 2;
/** Advice by an older picture is of other light. */
const ADVICE_S = 60;
/** Largest step of the button beside a picture, EV. */
const STEP_EV = 0.5;
/** The signs, each of another shape. */
const SIGNS = { good: "●", look: "◆", bad: "▲", none: "○" };

const cameras = new Map();
let large = null; // the camera whose picture is enlarged
let brighten = async () => {};

/** Sets how a camera's head is made brighter or darker by some EV. */
export const onBrighten = (doing) => (brighten = doing);

function tile(id) {
  const picture = make("img", { alt: t("tile-picture", { id }), hidden: true });
  const empty = make("span", { textContent: t("tile-empty") });
  const [sign, age] = [make("span", { className: "sign" }), make("span", { className: "age" })];
  const frame = make("button", { type: "button", className: "frame", onclick: () => enlarge(id) }, empty, picture);
  frame.setAttribute("aria-label", t("tile-enlarge", { id }));
  // What is wrong; where the exposure is, it is put right with a click.
  const said = make("button", { type: "button", className: "said", disabled: true });
  said.addEventListener("click", () => brighten(id, stepOf(id)));
  const box = make("figure", { className: "camera", id: `camera-${id}` },
    make("figcaption", { className: "title" }, sign, make("span", { className: "name", textContent: id }), age),
    frame, said);
  return { box, picture, empty, sign, age, said, number: 0, url: null, best: 0, fact: null, at: 0 };
}

/** How old a camera's picture is now, s; null where there is none. */
const ageOf = (shown) => (shown.fact?.number ? shown.fact.age_s + (performance.now() - shown.at) / 1000 : null);

/** How right the exposure of a camera is by its newest picture; null where that is old, or has no fringes. */
export function exposureOf(id) {
  const shown = cameras.get(id);
  return shown && ageOf(shown) !== null && ageOf(shown) < ADVICE_S ? (shown.fact.light?.exposure ?? null) : null;
}

/** By how much the button beside a picture changes the exposure, EV; 0 where it is right. */
function stepOf(id) {
  const exposure = exposureOf(id);
  if (!exposure || (Math.abs(exposure.ev) < 0.3 && exposure.saturated < 0.005)) return 0;
  return Math.max(-STEP_EV, Math.min(STEP_EV, exposure.ev));
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
  if (large) showLarge();
}

/** What is to be said of a picture's light, the worst first: {kind, words}; nothing where it is good. */
function remarks({ light, grades }) {
  const found = [];
  const kind = { bad: "bad", fair: "look" };
  const overexposed = t("tile-overexposed", { share: number(100 * light.saturated, light.saturated < 0.1 ? 1 : 0) });
  if (kind[grades.saturated]) found.push({ kind: kind[grades.saturated], words: overexposed });
  if (kind[grades.modulation]) found.push({ kind: kind[grades.modulation], words: t("tile-weak") });
  return found.sort((a, b) => a.kind.localeCompare(b.kind));
}

/** {kind, words} of a camera: what is wrong with it, then with its losses, then with its light. */
function judge(shown, { problem, lost, live }) {
  if (problem) return { kind: "bad", words: problem };
  if (lost) return { kind: "bad", words: t("tile-lost", { n: lost }) };
  if (!live || !shown.fact?.light) return { kind: "none", words: "" };
  return remarks(shown.fact)[0] ?? { kind: "good", words: "" };
}

function showTile(shown, from, camera) {
  const problem = cameraProblem(from, camera);
  const age = ageOf(shown);
  const live = !problem && age !== null && age < LIVE_S;
  const running = from.last.session && !from.last.session.outcome;
  shown.lost = running ? lossOf(from.last, camera.id) : 0;
  shown.live = live;
  const judged = judge(shown, { problem, lost: shown.lost, live });
  shown.box.className = `camera ${problem ? "bad" : live ? "live" : ""} ${live ? "" : "old"}`;
  shown.box.dataset.trigger = shown.fact?.trigger ?? "";
  shown.box.dataset.sign = judged.kind;
  text(shown.sign, SIGNS[judged.kind]);
  shown.sign.title = wordOf("sign", judged.kind);
  text(shown.age, age === null ? "" : live ? t("tile-live") : age < 10 ? `${Math.floor(age)} s` : span(age));
  shown.age.title = live ? "" : t("tile-age");
  const ev = problem || running || told.role === "view" ? 0 : stepOf(camera.id);
  shown.said.disabled = ev === 0;
  text(shown.said, ev < 0 ? t("tile-darken") : ev > 0 ? t("tile-brighten") : judged.words);
  shown.said.title = judged.words;
}

/** Where the square in full size lies, as parts of the picture's width and height; and the square's side, sensor px. */
let place = [0.5, 0.5];
const DETAIL_PX = 240;
/** Pixels of the sensor for one of the picture. */
const STEP_PX = 4;

function enlarge(id) {
  large = id;
  moveDetail([0.5, 0.5]);
  showLarge();
  $("large").showModal();
}
$("large").addEventListener("close", () => {
  large = null;
  $("large-light").hidden = $("large-pixels").hidden = true;
});
$("large-close").addEventListener("click", () => $("large").close());
$("large-frame").addEventListener("click", (event) => {
  const box = $("large-box").getBoundingClientRect();
  if (!$("large-box").contains(event.target)) $("large").close();
  else moveDetail([(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height]);
});
const ARROWS = { ArrowLeft: [-0.04, 0], ArrowRight: [0.04, 0], ArrowUp: [0, -0.025], ArrowDown: [0, 0.025] };
$("large").addEventListener("keydown", (event) => {
  const by = ARROWS[event.key];
  if (!by) return;
  event.preventDefault();
  moveDetail(place.map((at, axis) => at + by[axis]));
});

/** The square lies within the picture. */
function moveDetail(to) {
  const { naturalWidth, naturalHeight } = cameras.get(large).picture;
  const side = [naturalWidth, naturalHeight].map((length) => (length ? Math.min(1, DETAIL_PX / STEP_PX / length) : 1));
  place = to.map((at, axis) => Math.min(1 - side[axis] / 2, Math.max(side[axis] / 2, at)));
  const percent = (part) => `${100 * part}%`;
  Object.assign($("large-mark").style, { left: percent(place[0]), top: percent(place[1]), width: percent(side[0]), height: percent(side[1]) });
}

/** The enlarged picture with the figures behind its sign. */
function showLarge() {
  const shown = cameras.get(large);
  text($("large-title"), t("large-title", { id: large, age: shown.age.textContent || t("tile-empty") }));
  $("large-picture").src = shown.picture.src;
  $("large-picture").alt = shown.picture.alt;
  const light = shown.fact?.light;
  const figures = light ? [
    [t("large-overexposed"), `${number(100 * light.saturated, 2)} %`],
    [t("large-stripes"), t("large-stripes-are", { dn: number(light.modulation_dn, 0), contrast: number(100 * light.contrast, 0) })],
    // Sharpness has no right value: the best one so far stands beside it.
    [t("large-sharpness"), t("large-sharpness-is", { now: number(light.focus, 2), best: number(shown.best, 2) })],
    [t("large-exposure"), light.exposure ? t("large-exposure-is", { ev: `${light.exposure.ev < 0 ? "" : "+"}${number(light.exposure.ev, 1)}` }) : t("large-no-advice")],
    [t("large-lost"), number(shown.lost)],
  ] : [];
  const now = JSON.stringify(figures);
  if ($("large-figures").dataset.now === now) return;
  $("large-figures").dataset.now = now;
  $("large-figures").replaceChildren(...figures.map(([name, value]) => make("div", {}, make("dt", { textContent: name }), make("dd", { textContent: value }))));
}

export async function refreshPictures(peer) {
  for (const fact of await node.previews(peer)) {
    const shown = cameras.get(fact.camera);
    if (!shown) continue;
    shown.fact = fact;
    shown.at = performance.now();
    if (fact.light && ageOf(shown) < LIVE_S) shown.best = Math.max(shown.best, fact.light.focus);
    if (fact.camera === large) await Promise.all([refreshLight(peer, shown), refreshDetail(peer, shown)]);
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

/** Shows a blob in an image, in place of the one before. */
function showBlob(image, blob) {
  image.hidden = !blob;
  if (!blob) return;
  const before = image.src;
  image.src = URL.createObjectURL(blob);
  if (before) URL.revokeObjectURL(before);
}

async function refreshDetail(peer, shown) {
  const blob = await node.detail(peer, large, place).catch(() => null);
  showBlob($("large-pixels"), shown.live ? blob : null);
}

/** Lays over the enlarged picture what its light is good for. */
async function refreshLight(peer, shown) {
  const blob = await node.light(peer, large).catch(() => null);
  showBlob($("large-light"), shown.live ? blob : null);
}

// The tiles are made anew when they are shown next.
onLanguage(() => {
  cameras.clear();
  $("tiles").replaceChildren();
});
