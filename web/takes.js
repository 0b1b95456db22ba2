// The takes on the disks, newest first: verdict, causes, rating and note, and a search.

import { showBody } from "./body-panel.js";
import { lamp, lightOf, refreshLights, showLight } from "./calibration-light.js";
import { say } from "./controls.js";
import { $, make, text } from "./elements.js";
import { Refused, node } from "./node-client.js";
import { playButton, playableOf, refreshPlayable } from "./playable.js";
import { lookedAt, openLook } from "./quick-look.js";
import { nodes, sessionsUnderWay, told } from "./told.js";
import { causesOf, expectedOf, framesOf, kindOf, largeWord, worstOf } from "./verdict.js";
import { date, language, onLanguage, t, wordOf } from "./words.js";

const LISTED = 200;
const RATINGS = ["good", "doubtful", "bad"];

/** What is shown, as text: so that the list is made anew only when it has changed. */
let listed = "";
/** What each node listed last, for the search that is on: it stays when the node does not answer. */
const known = { search: "", lists: new Map() };

export async function refreshTakes() {
  const search = $("search").value.trim();
  const found = new Map();
  const all = nodes();
  const [lists] = await Promise.all([
    Promise.all(all.map(({ peer, status }) => (status ? node.sessions(peer, LISTED, search).catch(() => null) : null))),
    refreshLights(),
    refreshPlayable(),
  ]);
  if (search !== $("search").value.trim()) return;
  if (search !== known.search) Object.assign(known, { search, lists: new Map() });
  all.forEach(({ name }, i) => {
    if (lists[i]) known.lists.set(name, lists[i]);
    for (const entry of known.lists.get(name) ?? []) {
      const session = found.get(entry.name) ?? { name: entry.name, created_ns: entry.created_ns, parts: [] };
      session.parts.push({ node: name, entry });
      found.set(entry.name, session);
    }
  });
  const silent = all.filter((_, i) => !lists[i]).map(({ name }) => name);
  // What is only held or prepared is no take yet.
  const early = new Set(sessionsUnderWay().filter((session) => session.held || !session.triggers).map((session) => session.name));
  const takes = [...found.values()].filter(({ name }) => !early.has(name)).sort((a, b) => b.created_ns - a.created_ns).slice(0, LISTED).map((session) => sumUp(session, silent));
  // What is looked for hides no light: that of the last session is shown with its verdict, and says whose it is.
  const [last] = takes;
  const ended = last && last.word !== "recording";
  if (!search) $("verdict-light").hidden = !ended;
  if (!search && ended) showLight($("verdict-light"), last);
  const now = JSON.stringify([takes, search, language()]);
  // Nobody loses what they are writing, nor the button that they are about to press.
  if (now === listed || $("session-rows").contains(document.activeElement)) return;
  listed = now;
  const none = make("li", { className: "none", textContent: search ? t("takes-none-found", { search: JSON.stringify(search) }) : t("takes-none") });
  $("session-rows").replaceChildren(...(takes.length ? takes.map(row) : [none]));
}

function sumUp({ name, created_ns, parts }, silent) {
  const now = sessionsUnderWay().some((session) => session.name === name);
  const words = parts.map(({ entry }) => entry.verdict?.status ?? "unfinished");
  const missing = nodes().map(({ name }) => name).filter((name) => !parts.some((part) => part.node === name));
  const unknown = missing.filter((name) => silent.includes(name));
  const alone = missing.length > unknown.length;
  const word = now ? "recording" : alone && worstOf(words) === "complete" ? "partial" : worstOf(words);
  const verdicts = parts.flatMap(({ node: from, entry }) => (entry.verdict ? [{ from, verdict: entry.verdict }] : []));
  const frames = verdicts.reduce((sum, { verdict }) => sum + framesOf(verdict), 0);
  const expected = verdicts.reduce((sum, { verdict }) => sum + expectedOf(verdict), 0);
  const causes = verdicts.flatMap(({ from, verdict }) => causesOf(verdict).map((said) => t("node-says", { node: from, said })));
  if (!now) {
    for (const { node: from, entry } of parts) if (!entry.verdict) causes.push(t("node-says", { node: from, said: entry.problem ?? t("take-not-finished") }));
    if (alone) causes.push(t("take-alone", { nodes: parts.map(({ node: from }) => from).join(", ") }));
  }
  if (unknown.length) causes.push(t("take-silent", { nodes: unknown.join(", ") }));
  const { subject, note } = parts[0].entry;
  const remark = parts.map(({ entry }) => entry.remark).find(Boolean) ?? {};
  const id = parts.map(({ entry }) => entry.session_id).find(Boolean);
  const [light, playable] = [lightOf(name, id), playableOf(name, id)];
  return { name, created_ns, light, playable, word, kind: unknown.length && word === "complete" ? "warn" : kindOf(word), frames, expected, causes, subject, note, remark };
}

function row(take) {
  const facts = [date(take.created_ns), take.subject, take.expected ? t("frames-of", { frames: take.frames, n: take.expected }) : "", take.note];
  const head = make("p", { className: "head" },
    make("span", { className: "verdict", textContent: largeWord(take.word) }),
    make("span", { className: "name", textContent: take.name }),
    make("span", { className: "facts", textContent: facts.filter(Boolean).join(" · ") }));
  const item = make("li", { className: take.kind }, head);
  const below = make("div", { className: "below" });
  if (take.word !== "recording") below.append(lamp(take.light));
  below.append(remarkOf(take));
  item.append(below);
  if (take.causes.length) item.append(make("p", { className: "causes", textContent: take.causes.join("; ") }));
  item.dataset.name = take.name;
  return item;
}

/** Rating, note, quick look and player of a take. */
function remarkOf(take) {
  const may = told.role !== "view";
  const remark = { rating: take.remark.rating ?? null, note: take.remark.note ?? null };
  const problem = make("p", { className: "causes", role: "alert" });
  const buttons = RATINGS.map((rating) => {
    const label = wordOf("rating", rating);
    const button = make("button", { type: "button", textContent: label, disabled: !may, onclick: () => keep({ rating: remark.rating === rating ? null : rating }) });
    button.setAttribute("aria-label", t("take-rate", { name: take.name, rating: label }));
    return button;
  });
  const note = make("input", { value: remark.note ?? "", placeholder: t("take-note-hint"), maxLength: 500, disabled: !may, onchange: () => keep({ note: note.value.trim() || null }) });
  note.setAttribute("aria-label", t("take-note", { name: take.name }));
  const look = make("button", { type: "button", textContent: t("take-look"), onclick: () => openLook(take.name) });
  look.setAttribute("aria-label", t("take-look-label", { name: take.name }));
  const mark = () => RATINGS.forEach((rating, i) => buttons[i].setAttribute("aria-pressed", String(remark.rating === rating)));
  let kept = Promise.resolve();
  /** One after the other: what was said last is what stays. */
  function keep(change) {
    Object.assign(remark, change);
    mark();
    const said = { ...remark };
    kept = kept.then(async () => text(problem, await remarkOn(take.name, said)));
  }
  mark();
  return make("div", { className: "remarks" }, make("div", { className: "remark", role: "group" }, ...buttons, note, look, ...playButton(take)), problem);
}

/** Keeps rating and note of a take on all nodes that have recorded it; what was not kept, in sentences. */
async function remarkOn(name, remark) {
  const told = await Promise.allSettled(nodes().map(({ peer }) => node.remark(peer, name, remark)));
  const failed = told.flatMap(({ reason }) => reason ?? []);
  // A node that has no part of the take has nothing to keep.
  const wrong = failed.filter((error) => !(error instanceof Refused && error.status === 404) || failed.length === told.length);
  return wrong.map((error) => t("take-not-kept", { why: error.message })).join("; ");
}

/** Rates the take that is shown, and shows the live body. Its note stays: the list may not have the take now. */
async function rate(rating) {
  const name = lookedAt();
  showBody("live");
  const lists = await Promise.allSettled(nodes().map(({ peer }) => node.sessions(peer, LISTED, name)));
  const entries = lists.flatMap(({ value }) => value ?? []).filter((entry) => entry.name === name);
  const { note } = entries.map(({ remark }) => remark).find(Boolean) ?? {};
  const problem = await remarkOn(name, { rating, note: note ?? null });
  if (problem) say(problem);
  await refreshTakes();
}

// After a take: it is good, or it is made again as it was asked for.
$("keep").addEventListener("click", () => rate("good").catch(() => {}));
$("repeat").addEventListener("click", () => {
  rate("bad").catch(() => {});
  if (!$("start").disabled) $("start").click();
});

let waiting = null;
$("search").addEventListener("input", () => {
  clearTimeout(waiting);
  waiting = setTimeout(() => refreshTakes().catch(() => {}), 250);
});
onLanguage(() => refreshTakes().catch(() => {}));
