// What the subject is told, on a screen of their own: the countdown, hold still, done.

import { $, text } from "./elements.js";
import { Refused, node } from "./node-client.js";
import { onLanguage, t } from "./words.js";

const POLL_MS = 150;
/** How long "done" stands before the screen says nothing again. */
const DONE_MS = 15000;
let ended = null;
/** What shows the present text, in the language of the moment. */
let again = () => {};

/** {kind, word, detail, left}: what to tell for this capture. */
function said(capture, rate) {
  const wait = { kind: "", word: t("subject-wait"), detail: "" };
  if (!capture) return wait;
  const { takes } = capture.series;
  const more = takes > 1 ? t("subject-of", { take: capture.take, takes }) : "";
  const at = capture.stage;
  if (capture.running) {
    ended = null;
    if (!at) return { kind: "", word: t("subject-rest"), detail: t("subject-of-done", { done: capture.takes.length, takes }) };
    if (at.stage === "counting_down") return { kind: "count", word: String(at.left_s), detail: more };
    if (at.stage !== "recording") return { kind: "", word: ["preparing", "awaiting_edge", "holding"].includes(at.stage) ? t("subject-ready") : t("subject-hold"), detail: more };
    if (!at.triggers) return { kind: "", word: t("subject-ready"), detail: more };
    const left = at.asked ? Math.max(0, (at.asked - at.triggers) / at.asked) : null;
    const seconds = at.asked ? `${Math.ceil((at.asked - at.triggers) / rate)} s` : more;
    return { kind: "hold", word: t("subject-hold"), detail: seconds, left };
  }
  ended ??= { number: capture.number, at: performance.now() };
  const over = performance.now() - ended.at > DONE_MS;
  if (over || capture.fault || !capture.takes.length) return wait;
  return { kind: "done", word: t("subject-done"), detail: t("subject-thanks") };
}

async function loop() {
  let rate = 1;
  for (;;) {
    try {
      rate = (await node.status()).trigger_rate_hz;
      break;
    } catch (error) {
      if (error instanceof Refused) text($("detail"), t("subject-login"));
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
      again = () => show(said(capture, rate));
      again();
    } catch (error) {
      show({ kind: "", word: t("subject-wait"), detail: error instanceof Refused ? t("subject-login") : "" });
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
onLanguage(() => again());
loop();
