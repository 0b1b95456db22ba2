// What a take, a series or a session amounts to: a word, its kind, and every cause.

import { nodes, told } from "./told.js";
import { t, wordOf } from "./words.js";

/** From the worst to the best. */
const WORDS = ["aborted", "unfinished", "incomplete", "unconfirmed", "partial", "complete"];
const KINDS = { complete: "good", partial: "warn", unconfirmed: "warn", incomplete: "bad", recording: "warn" };
export const kindOf = (word) => KINDS[word] ?? "bad";
export const worstOf = (words) => WORDS.find((word) => words.includes(word)) ?? "aborted";

/** A word of WORDS as it stands in large letters. */
export const largeWord = (word) => wordOf("verdict", word).toUpperCase();

/** Gaps of a camera in words: `12 unplugged, 3 late`. */
const gapsOf = (camera) => Object.entries(camera.gaps).map(([cause, number]) => `${number} ${wordOf("cause", cause)}`).join(", ");

/** Why one node's verdict is not complete. */
export function causesOf(verdict) {
  const lines = verdict.cameras.filter((camera) => Object.keys(camera.gaps).length).map((camera) => `${camera.camera}: ${gapsOf(camera)}`);
  lines.push(...(verdict.advice ?? []));
  if (verdict.untimed) lines.push(t("why-untimed", { n: verdict.untimed }));
  if (verdict.unconfirmed) lines.push(t("why-unconfirmed", { n: verdict.unconfirmed }));
  lines.push(...(verdict.changed ?? []).map((what) => t("why-changed", { what })));
  lines.push(...(verdict.not_simultaneous ?? []).map((what) => t("why-not-simultaneous", { what })));
  if (verdict.refused) lines.push(t("why-refused", { n: verdict.refused }));
  if (verdict.aborted) lines.push(t("why-aborted", { why: verdict.aborted }));
  return lines;
}

export const framesOf = (verdict) => verdict.cameras.reduce((sum, camera) => sum + camera.frames, 0);
export const expectedOf = (verdict) => Math.max(verdict.triggers, verdict.triggers_expected ?? 0) * verdict.cameras.length;

/** Frames and causes of a take, which has {node, session} of each node. */
function sumUp(take) {
  const sum = { name: take.name, word: take.verdict, frames: 0, expected: 0, causes: [] };
  for (const { node, session } of take.nodes) {
    const verdict = session.outcome?.recorded;
    if (verdict) {
      sum.frames += framesOf(verdict);
      sum.expected += expectedOf(verdict);
      sum.causes.push(...[...causesOf(verdict), ...(session.notices ?? [])].map((said) => t("node-says", { node, said })));
    } else {
      const written = session.cameras.reduce((frames, camera) => frames + camera.frames, 0);
      const said = session.outcome?.failed?.message ?? t("result-no-verdict");
      sum.causes.push(t("node-says", { node, said: t("result-last-status", { said, n: written }) }));
    }
  }
  if (take.not_asked?.length) sum.causes.push(t("result-no-part", { nodes: take.not_asked.join(", ") }));
  return sum;
}

/** A fault's message; the same reason of several nodes is shown once. */
function saidOnce(message) {
  const parts = message.split("; ").map((part) => part.match(/^node ([^:]+): (.*)$/s));
  if (parts.length < 2 || parts.some((part) => !part || part[2] !== parts[0][2])) return message;
  return t("nodes-say", { nodes: parts.map((part) => part[1]).join(", "), said: parts[0][2] });
}

/** {kind, word, detail} of a series that has ended. */
function ofCapture(capture) {
  const { wish, takes: asked } = capture.series;
  const takes = capture.takes.map(sumUp);
  const sum = (key) => takes.reduce((total, take) => total + take[key], 0);
  const lines = [];
  if (capture.fault) {
    const said = saidOnce(capture.fault.message);
    lines.push(asked > 1 ? t("result-take-fault", { take: capture.take, takes: asked, said }) : said);
    if (takes.length) lines.push(t("result-kept", { n: takes.length }));
  }
  // The first line is the one that is read from afar.
  for (const take of takes) {
    if (!take.causes.length) continue;
    const head = takes.length > 1 ? `${take.name} ${largeWord(take.word)}: ` : "";
    lines.push(...take.causes.map((cause) => head + cause));
  }
  if (takes.length) {
    const names = takes.map(({ name }) => name);
    const which = names.length > 2 ? `${names[0]} … ${names.at(-1)}` : names.join(", ");
    const of = asked > 1 ? `${t("takes-of", { takes: takes.length, n: asked })}, ` : "";
    lines.push(`${of}${t("frames-of", { frames: sum("frames"), n: sum("expected") })}: ${which}`);
  }
  if (wish.dry_run) lines.push(t("result-dry-run"));
  if (capture.stopped) lines.push(capture.stopped);
  if (capture.fault && !takes.length && capture.asked_to_end) return { kind: "warn", word: t("result-stopped"), detail: lines.join("\n") };
  if (capture.fault) return { kind: "bad", word: t("result-failed"), detail: lines.join("\n") };
  if (!takes.length) return { kind: "warn", word: t("result-stopped"), detail: capture.stopped ?? t("result-nothing-recorded") };
  const word = worstOf(takes.map((take) => take.word));
  return { kind: kindOf(word), word: largeWord(word), detail: lines.join("\n") };
}

/** The same of a session that was begun elsewhere, from what every node says of it. */
function ofSession(name) {
  const parts = nodes().filter(({ status }) => status?.session?.name === name && status.session.outcome);
  const take = { name, nodes: parts.map(({ name: node, status }) => ({ node, session: status.session })) };
  const words = take.nodes.map(({ session }) => session.outcome.recorded?.status ?? "aborted");
  const missing = parts[0].status.session.nodes.filter((node) => !parts.some((part) => part.name === node));
  if (missing.length) words.push("unfinished");
  take.verdict = worstOf(words);
  if (take.nodes.every(({ session }) => session.outcome.failed)) {
    return { kind: "bad", word: t("result-failed"), detail: `${name}: ${[...new Set(take.nodes.map(({ session }) => session.outcome.failed.message))].join("; ")}` };
  }
  const { word, frames, expected, causes } = sumUp(take);
  const lines = [`${t("result-elsewhere", { name })}: ${t("frames-of", { frames, n: expected })}`, ...causes, ...missing.map((node) => t("node-says", { node, said: t("result-no-verdict-yet") }))];
  return { kind: kindOf(word), word: largeWord(word), detail: lines.join("\n") };
}

/** The verdict that stays until the next session; null before the first. */
export function lastVerdict() {
  const capture = told.capture;
  const session = told.status?.session;
  const ours = capture && session && (capture.takes.some((take) => take.name === session.name) || session.outcome?.failed || session.dry_run);
  if (session?.outcome && !ours) return ofSession(session.name);
  return capture ? ofCapture(capture) : null;
}
