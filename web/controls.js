// What the operator does: record, stop, preview, dry run, abort; by mouse and by keys. The buttons never move.

import { $, make, text } from "./elements.js";
import { node } from "./node-client.js";
import { notReady, sessionsUnderWay, told } from "./told.js";

/** The HSU's inputs, an edge of which may begin a session: `LINE:rising` or `LINE:falling`. */
const INPUTS = 8;
for (let line = 0; line < INPUTS; line++) {
  for (const edge of ["rising", "falling"]) $("start-on").append(make("option", { value: `${line}:${edge}`, textContent: `when the signal on input ${line} goes ${edge === "rising" ? "on" : "off"}` }));
}

let refused = null; // why the last button's request was refused
let afterwards = async () => {};

/** What is done after each request. */
export const onAct = (doing) => (afterwards = doing);

/** Seconds before Record and after Stop, where they are filled in. */
function spans() {
  const seconds = (id) => Number($(id).value.trim()) || null;
  return { pre_trigger_s: seconds("before"), post_trigger_s: seconds("after") };
}

/** Whether frames are held until Record, by a capture of this node. */
const holding = () => Boolean(told.capture?.running) && told.capture.stage?.stage === "holding";

function series(extra = {}) {
  const filled = (id) => $(id).value.trim() || null;
  const seconds = filled("seconds");
  const [line, edge] = $("start-on").value.split(":");
  return {
    wish: { ...spans(), name: filled("name"), subject: filled("subject"), note: filled("note"), duration_s: seconds ? Number(seconds) : null, countdown_s: Number(filled("countdown") ?? 0), partial: $("partial").checked, start_on: edge ? { line: Number(line), rising: edge === "rising" } : null, ...extra },
    takes: Number(filled("takes") ?? 1),
    pause_s: 0,
    // A name that is taken gets the next number.
    number: true,
  };
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
  const missing = running ? null : notReady($("partial").checked);
  for (const id of ["look", "dry"]) $(id).disabled = running || !may || missing !== null;
  $("start").disabled = !may || (!holding() && (running || missing !== null));
  text($("start-word"), !running && spans().pre_trigger_s ? "Hold" : "Record");
  for (const id of ["stop", "abort"]) $(id).disabled = !running || !may;
  const looks = may ? null : "this token may only view (role view)";
  text($("why"), refused ?? looks ?? missing ?? (running && told.noBody ? `no live body: ${told.noBody}` : ""));
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
$("look").addEventListener("click", () => act(() => node.begin({ wish: { dry_run: true, note: "preview" }, takes: 1 })));
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
  if ($("exposure").open) return;
  if (event.target.matches("input, select, textarea")) {
    if (event.key === "Escape") event.target.blur();
    return;
  }
  if (event.key === "/") {
    event.preventDefault();
    $("search").focus();
  }
  if (KEYS[event.key]) $(KEYS[event.key]).click();
});

$("subject-screen").addEventListener("click", () => window.open("subject.html", "fourdbody-subject"));
