// Exposure and gain of the heads: what is set, what would be right, and a form that sets it on all nodes at once.

import { $, make, text } from "./elements.js";
import { say } from "./controls.js";
import { node } from "./node-client.js";
import { exposureOf, onBrighten } from "./tiles.js";
import { nodes, told } from "./told.js";
import { number, onLanguage, t } from "./words.js";

/** Rows of the form, by head. */
const rows = new Map();
let busy = false;

/** Every head with what its cameras are asked for and are advised: {head, cameras, us, db, most_us, ev, differs}. */
function heads() {
  const found = new Map();
  for (const { last } of nodes()) {
    for (const { id, exposure } of last?.cameras ?? []) {
      if (!exposure) continue;
      const head = found.get(exposure.head) ?? { head: exposure.head, cameras: [], most_us: exposure.most_us, us: null, db: null, ev: null, differs: false };
      head.cameras.push(id);
      head.us ??= exposure.exposure_us;
      head.db ??= exposure.gain_db;
      head.differs ||= exposure.differs;
      const advised = exposureOf(id);
      // Nothing of either camera may saturate: the lesser advice is the head's.
      if (advised) head.ev = Math.min(head.ev ?? Infinity, advised.ev);
      found.set(exposure.head, head);
    }
  }
  return [...found.values()].sort((a, b) => a.head.localeCompare(b.head));
}

/** What the advice comes to, us: within what the trigger period leaves. */
const advised_us = ({ us, ev, most_us }) => Math.round(Math.min(us * 2 ** ev, most_us - 0.05) * 10) / 10;

function row(head) {
  const field = (label) => {
    const input = make("input", { type: "number", step: "any", min: "0", required: true });
    input.setAttribute("aria-label", label);
    return input;
  };
  const shown = { us: field(t("exposure-us-label", { head })), db: field(t("exposure-db-label", { head })), advice: make("button", { type: "button" }), set: make("button", { textContent: t("exposure-set"), className: "go" }), now: make("p", { className: "facts" }), edited: false };
  shown.set.setAttribute("aria-label", t("exposure-set-head", { head }));
  for (const input of [shown.us, shown.db]) input.addEventListener("input", () => (shown.edited = true));
  shown.advice.addEventListener("click", () => {
    shown.us.value = advised_us(heads().find((one) => one.head === head));
    shown.edited = true;
  });
  shown.form = make("form", { className: "head-exposure" }, make("b", { textContent: head }), make("label", {}, t("exposure-us"), " ", shown.us), make("label", {}, "dB ", shown.db), shown.advice, shown.set, shown.now);
  shown.form.dataset.head = head;
  shown.form.addEventListener("submit", (event) => {
    event.preventDefault();
    // What the node file leaves to raw settings is not said.
    const { us, db } = heads().find((one) => one.head === head);
    set(head, us === null ? null : Number(shown.us.value), db === null ? null : Number(shown.db.value));
  });
  return shown;
}

export function showExposure() {
  if (!$("exposure").open) return;
  const all = heads();
  for (const head of all) {
    if (!rows.has(head.head)) rows.set(head.head, row(head.head));
    const shown = rows.get(head.head);
    [shown.us.disabled, shown.db.disabled] = [head.us === null, head.db === null];
    if (!shown.edited && head.us !== null) shown.us.value = head.us;
    if (!shown.edited && head.db !== null) shown.db.value = head.db;
    const known = head.ev !== null && head.us !== null;
    const limited = known && head.us * 2 ** head.ev > head.most_us;
    const advice = known ? { ev: `${head.ev < 0 ? "" : "+"}${number(head.ev, 1)}`, us: advised_us(head) } : null;
    text(shown.advice, !advice ? t("exposure-no-advice") : limited ? t("exposure-advice-most", advice) : t("exposure-advice", advice));
    shown.advice.disabled = !known;
    shown.set.disabled = busy || told.role === "view";
    const cameras = head.cameras.join(", ");
    const now = head.us === null ? t("exposure-raw", { cameras }) : t("exposure-now", { cameras, us: head.us, db: head.db ?? "?", most: number(head.most_us, 0) });
    text(shown.now, now + (head.differs ? t("exposure-differs") : ""));
  }
  const forms = all.map(({ head }) => rows.get(head).form);
  if ($("exposure-heads").childElementCount !== forms.length) $("exposure-heads").replaceChildren(...forms);
}

async function set(head, exposure_us, gain_db) {
  busy = true;
  text($("exposure-said"), t("exposure-setting", { head }));
  showExposure();
  try {
    // A node that is gone is asked, too: what it does not take is told.
    const asked = nodes().filter(({ last }) => last?.cameras.some(({ exposure }) => exposure?.head === head));
    const answers = await Promise.allSettled(asked.map(({ peer }) => node.expose(peer, { heads: [head], exposure_us, gain_db })));
    const lines = answers.flatMap(({ value, reason }, i) => (reason ? [t("node-says", { node: asked[i].name, said: reason.message })] : value.cameras.map(taken)));
    const failed = answers.some(({ reason }) => reason);
    const ids = answers.flatMap(({ value }) => value?.cameras.map(({ id }) => id) ?? []);
    if (!failed) lines.push(t("exposure-keep", { cameras: ids.join(", "), lines: [["exposure_us", exposure_us], ["gain_db", gain_db]].filter(([, value]) => value !== null).map(([word, value]) => `${word} = ${value}`).join(", ") }));
    text($("exposure-said"), lines.join("\n"));
    $("exposure-said").className = failed ? "bad" : "";
    // The dialog may never have been open: a tile's button sets as well.
    if (!failed && rows.has(head)) rows.get(head).edited = false;
  } catch (error) {
    text($("exposure-said"), error.message);
    $("exposure-said").className = "bad";
  } finally {
    busy = false;
    showExposure();
  }
}

/** What a camera took, in its own features. */
const taken = ({ id, exposure_us, gain_db, taken }) =>
  t("exposure-taken", { id, us: exposure_us, db: gain_db, features: taken.map(({ feature, actual }) => `${feature} ${typeof actual === "number" ? Math.round(actual * 100) / 100 : actual}`).join(", ") });

$("exposure-open").addEventListener("click", () => {
  for (const shown of rows.values()) shown.edited = false;
  text($("exposure-said"), "");
  $("exposure").showModal();
  showExposure();
});
$("exposure-close").addEventListener("click", () => $("exposure").close());

/** Sets a camera's head brighter or darker, within what the trigger period leaves; the dialog shows what was taken. */
onBrighten(async (id, ev) => {
  const head = heads().find(({ cameras }) => cameras.includes(id));
  if (!head || head.us === null || busy) return;
  await set(head.head, advised_us({ ...head, ev }), head.db);
  say($("exposure-said").textContent.split("\n")[0]);
});

$("exposure-all").addEventListener("click", async () => {
  const lines = [];
  for (const head of heads().filter(({ us, ev }) => us !== null && ev !== null)) {
    await set(head.head, advised_us(head), head.db);
    lines.push($("exposure-said").textContent);
  }
  text($("exposure-said"), lines.join("\n") || t("exposure-none"));
});

// The rows of heads are made anew when they are shown next.
onLanguage(() => {
  rows.clear();
  $("exposure-heads").replaceChildren();
});
