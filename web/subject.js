// What the subject is told, on a screen of their own: the countdown, hold still, done.

import { $, text } from "./elements.js";
import { Refused, node } from "./node-client.js";

const POLL_MS = 150;
/** How long "done" stands before the screen says nothing again. */
const DONE_MS = 15000;
let ended = null;

/** {kind, word, detail, left}: what to tell for this capture. */
function said(capture, rate) {
  const wait = { kind: "", word: "PLEASE WAIT", detail: "" };
  if (!capture) return wait;
  const { takes } = capture.series;
  const more = takes > 1 ? `${capture.take} of ${takes}` : "";
  const at = capture.stage;
  if (capture.running) {
    ended = null;
    if (!at) return { kind: "", word: "REST", detail: `${capture.takes.length} of ${takes} done` };
    if (at.stage === "counting_down") return { kind: "count", word: String(at.left_s), detail: more };
    if (at.stage !== "recording") return { kind: "", word: ["preparing", "awaiting_edge", "holding"].includes(at.stage) ? "GET READY" : "HOLD STILL", detail: more };
    if (!at.triggers) return { kind: "", word: "GET READY", detail: more };
    const left = at.asked ? Math.max(0, (at.asked - at.triggers) / at.asked) : null;
    const seconds = at.asked ? `${Math.ceil((at.asked - at.triggers) / rate)} s` : more;
    return { kind: "hold", word: "HOLD STILL", detail: seconds, left };
  }
  ended ??= { number: capture.number, at: performance.now() };
  const over = performance.now() - ended.at > DONE_MS;
  if (over || capture.fault || !capture.takes.length) return wait;
  return { kind: "done", word: "DONE", detail: "thank you; please wait where you are" };
}

async function loop() {
  let rate = 1;
  for (;;) {
    try {
      rate = (await node.status()).trigger_rate_hz;
      break;
    } catch (error) {
      if (error instanceof Refused) text($("detail"), "the operator has to log in on this screen first");
      await new Promise((resolve) => setTimeout(resolve, 1000));
    }
  }
  // A page that is opened later does not thank for what is over.
  let first = true;
  for (;;) {
    try {
      const capture = await node.capture();
      if (first && capture && !capture.running) ended = { number: capture.number, at: -Infinity };
      first = false;
      show(said(capture, rate));
    } catch (error) {
      show({ kind: "", word: "PLEASE WAIT", detail: error instanceof Refused ? "the operator has to log in on this screen first" : "" });
    }
    await new Promise((resolve) => setTimeout(resolve, POLL_MS));
  }
}

function show({ kind, word, detail, left }) {
  $("subject").className = kind;
  text($("word"), word);
  text($("detail"), detail);
  $("left").hidden = left == null;
  $("left-bar").style.width = `${100 * (left ?? 0)}%`;
}

const full = () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen());
$("full").addEventListener("click", full);
document.addEventListener("keydown", (event) => event.key === "f" && full());
loop();
