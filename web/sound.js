// Sound at the countdown, at the start, at the end, and when a frame is lost; it can be muted, and that is remembered.

import { $, text } from "./elements.js";
import { onLanguage, t } from "./words.js";

/** Frequency (Hz) and length (s) of each tone, one after the other. */
const TONES = {
  tick: [[880, 0.08]],
  start: [[1320, 0.3]],
  end: [[880, 0.15], [1320, 0.25]],
  loss: [[220, 0.18], [180, 0.28]],
};
const KEY = "fourdbody-muted";

let context = null;
let muted = localStorage.getItem(KEY) === "yes";
const last = { left: null, running: false, lost: 0 };

export function play(name) {
  // What would sound is counted, so that a deaf machine can be asked.
  const played = JSON.parse(document.body.dataset.sounds ?? "{}");
  document.body.dataset.sounds = JSON.stringify({ ...played, [name]: (played[name] ?? 0) + 1 });
  if (muted || !context) return;
  let at = context.currentTime;
  for (const [frequency, length] of TONES[name]) {
    const [oscillator, gain] = [context.createOscillator(), context.createGain()];
    oscillator.frequency.value = frequency;
    gain.gain.setValueAtTime(0.25, at);
    gain.gain.exponentialRampToValueAtTime(0.001, at + length);
    oscillator.connect(gain).connect(context.destination);
    oscillator.start(at);
    oscillator.stop(at + length);
    at += length;
  }
}

/**
 * Plays what has happened since this was called last. `capture` is the node's, `lost` how many frames are lost now.
 * A second of the countdown has no tick where no answer of the node came within it: a late one would deceive the subject.
 */
export function listen(capture, lost) {
  const left = capture?.running && capture.stage?.stage === "counting_down" ? capture.stage.left_s : null;
  const running = Boolean(capture?.running && capture.stage?.stage === "recording" && capture.stage.triggers);
  if (left !== null && left !== last.left) play("tick");
  if (running && !last.running) play("start");
  if (!running && last.running) play("end");
  if (lost > last.lost) play("loss");
  Object.assign(last, { left, running, lost });
}

function show() {
  $("mute").setAttribute("aria-pressed", String(muted));
  text($("mute-word"), muted ? t("sound-off") : t("sound-on"));
}

$("mute").addEventListener("click", () => {
  muted = !muted;
  localStorage.setItem(KEY, muted ? "yes" : "no");
  show();
});
// A browser lets a page sound only once somebody has touched it.
for (const touch of ["pointerdown", "keydown"]) addEventListener(touch, () => (context ??= new AudioContext()), { once: true });
onLanguage(show);
