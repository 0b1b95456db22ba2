// What the operator does: record, stop, preview, dry run, abort; by mouse and by keys. The buttons never move.

import { bodyKey } from "./body-panel.js";
import { $, text } from "./elements.js";
import { asked, defaultName, series } from "./form.js";
import { node } from "./node-client.js";
import { cannotRecord, cannotRun, devicesAnswer, sessionsUnderWay, told } from "./told.js";
import { t } from "./words.js";

let pictures = null; // whether the operator wants pictures while nothing is recorded; null: as the node file has it
let refused = null; // why the last button's request was refused
let afterwards = async () => {};

/** What is done after each request. */
export const onAct = (doing) => (afterwards = doing);

/** Whether frames are held until Record, by a capture of this node. */
const holding = () => Boolean(told.capture?.running) && told.capture.stage?.stage === "holding";

/** Shows a sentence below the buttons until the next of them is pressed. */
export function say(sentence) {
  refused = sentence;
  showControls();
}

/** Whether cameras shall run for this page while nothing is recorded. */
const wantsPictures = () => told.role !== "view" && (pictures ?? told.status?.live_preview ?? false);

/** Keeps the cameras running for this page, where it wants that and nothing else uses them. */
export async function keepPictures() {
  const busy = told.capture?.running || sessionsUnderWay().length > 0;
  if (wantsPictures() && !busy && !document.hidden && devicesAnswer()) await node.preview();
}

async function act(doing) {
  refused = null;
  try {
    await doing();
  } catch (error) {
    refused = error.message;
  }
  await afterwards();
}

export function showControls() {
  const running = Boolean(told.capture?.running) || sessionsUnderWay().length > 0;
  const may = told.role !== "view";
  const wish = asked();
  // Without a recording no disk is needed.
  $("dry").disabled = running || !may || cannotRun(wish) !== null;
  const missing = running ? null : cannotRecord(wish);
  $("start").disabled = !may || (!holding() && (running || missing !== null));
  text($("start-word"), !running && wish.before ? t("hold") : t("record"));
  $("name").placeholder = defaultName();
  $("look").disabled = !may;
  $("look").setAttribute("aria-pressed", String(wantsPictures()));
  for (const id of ["stop", "abort"]) $(id).disabled = !running || !may;
  const looks = may ? null : t("cannot-role");
  text($("why"), refused ?? looks ?? missing ?? "");
  $("why").title = $("why").textContent;
  $("why").className = refused || missing ? "bad" : "";
  if (!running && $("abort-question").open) $("abort-question").close();
}

$("capture").addEventListener("submit", (event) => {
  event.preventDefault();
  if ($("start").disabled) return;
  act(() => (holding() ? node.record() : node.begin(series())));
});
$("stop").addEventListener("click", () => act(() => node.stop()));
$("look").addEventListener("click", () => {
  pictures = !wantsPictures();
  showControls();
});
$("dry").addEventListener("click", () => $("capture").reportValidity() && act(() => node.begin(series({ dry_run: true, pre_trigger_s: null }))));
$("abort").addEventListener("click", () => $("abort-question").showModal());
$("abort-question").addEventListener("close", () => {
  if ($("abort-question").returnValue === "abort") act(() => node.abort("aborted at the console"));
  $("abort-question").returnValue = "";
});

const KEYS = { r: "start", s: "stop", p: "look", d: "dry", a: "abort", e: "exposure-open", m: "mute" };
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey || $("console").hidden) return;
  if ($("abort-question").open) {
    if (event.key === "y") $("abort-yes").click();
    return;
  }
  if ($("exposure").open || $("large").open) return;
  if (event.target.matches("input, select, textarea")) {
    if (event.key === "Escape") event.target.blur();
    return;
  }
  if (event.key === "/") {
    event.preventDefault();
    $("search").focus();
  }
  if (KEYS[event.key]) $(KEYS[event.key]).click();
  else if (bodyKey(event.key)) event.preventDefault();
});

$("subject-screen").addEventListener("click", () => window.open("subject.html", "fourdbody-subject"));
