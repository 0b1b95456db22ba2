// What the capture form asks for: a series of takes, and how much of the disk that needs.

import { $, make } from "./elements.js";
import { onLanguage, t } from "./words.js";

/** The HSU's inputs, an edge of which may begin a session: `LINE:rising` or `LINE:falling`. */
const INPUTS = 8;
for (let line = 0; line < INPUTS; line++) {
  for (const edge of ["rising", "falling"]) {
    const option = make("option", { value: `${line}:${edge}` });
    onLanguage(() => (option.textContent = t(`form-start-${edge}`, { line })));
    $("start-on").append(option);
  }
}

const filled = (id) => $(id).value.trim() || null;
const number = (id) => Number(filled(id)) || null;

/** The name of a take that is given none: the day, and the subject. */
export function defaultName() {
  const now = new Date();
  const day = [now.getFullYear(), now.getMonth() + 1, now.getDate()].map((part) => String(part).padStart(2, "0")).join("-");
  const subject = (filled("subject") ?? "").replace(/[^A-Za-z0-9_.-]+/g, "-");
  return [day, subject].filter(Boolean).join("_").slice(0, 60);
}

/** How much is asked for: seconds of a take (null: until Stop), seconds before Record and after Stop, takes. */
export const asked = () => ({
  seconds: number("seconds"),
  before: number("before") ?? 0,
  after: number("after") ?? 0,
  takes: number("takes") ?? 1,
  partial: $("partial").checked,
});

/** The series as the node takes it. */
export function series(extra = {}) {
  const [line, edge] = $("start-on").value.split(":");
  const wish = {
    name: filled("name") ?? defaultName(),
    subject: filled("subject"),
    note: filled("note"),
    duration_s: number("seconds"),
    countdown_s: number("countdown") ?? 0,
    pre_trigger_s: number("before"),
    post_trigger_s: number("after"),
    partial: $("partial").checked,
    start_on: edge ? { line: Number(line), rising: edge === "rising" } : null,
  };
  // A name that is taken gets the next number.
  return { wish: { ...wish, ...extra }, takes: number("takes") ?? 1, pause_s: 0, number: true };
}
