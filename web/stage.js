// State and verdict in letters that are read from three metres.

import { $, text } from "./elements.js";
import { asked } from "./form.js";
import { GONE_S, LATE_S, cannotRecord, isInPreview, lossOf, nodes, problems, sessionsUnderWay, silence_s, told } from "./told.js";
import { lastVerdict } from "./verdict.js";
import { t, wordOf } from "./words.js";

/** Triggers as seconds, with a point in every language: scripts read them. */
function clock(triggers, asked) {
  const rate = told.status.trigger_rate_hz;
  const seconds = (triggers / rate).toFixed(1);
  return asked ? t("clock-of", { part: seconds, whole: (asked / rate).toFixed(1) }) : `${seconds} s`;
}

/** Where everything stands: {kind, word, clock, detail, share}. */
export function state() {
  if (silence_s() > GONE_S) return { kind: "bad", word: t("state-no-answer"), detail: t("state-no-answer-detail", { node: told.status.node }) };
  if (silence_s() > LATE_S) return { kind: "", word: t("state-no-news"), detail: t("state-no-news-detail", { node: told.status.node, seconds: Math.floor(silence_s()) }) };
  const trouble = problems();
  const more = trouble.length ? [trouble.join("\n")] : [];
  const capture = told.capture;
  if (capture?.running) return underWay(capture, more);
  const [session] = sessionsUnderWay();
  if (session) {
    const running = session.triggers > 0;
    if (session.held) return { kind: "look", word: t("state-standby"), detail: t("elsewhere-standby", { name: session.name }) };
    const detail = [t("elsewhere", { name: session.name }), ...more].join("\n");
    if (!running) return { kind: "warn", word: t("state-preparing"), detail };
    const [kind, word] = session.dry_run ? ["look", t("state-dry-run")] : ["live", t("state-recording")];
    return { kind, word, clock: clock(session.triggers, session.triggers_asked), detail, share: share(session.triggers, session.triggers_asked) };
  }
  const missing = cannotRecord(asked());
  if (missing) return { kind: "bad", word: t("state-not-ready"), detail: [missing, ...trouble.filter((one) => one !== missing)].join("\n") };
  const cameras = nodes().reduce((sum, { status }) => sum + status.cameras.length, 0);
  const live = nodes().some(({ status }) => isInPreview(status)) ? `\n${t("state-live-pictures")}` : "";
  return { kind: "good", word: t("state-ready"), detail: t("state-ready-detail", { n: cameras }) + live };
}

const share = (triggers, asked) => (asked ? triggers / asked : null);

function underWay(capture, more) {
  const at = capture.stage;
  const { takes, wish } = capture.series;
  const take = takes > 1 ? [t("state-take", { take: capture.take, takes })] : [];
  const detail = (line) => [[...take, line].join(": "), ...more].join("\n");
  if (!at) return { kind: "warn", word: t("state-pause"), detail: detail(t("state-pause-detail", { n: capture.takes.length })) };
  if (at.stage === "preparing") return { kind: "warn", word: t("state-preparing"), detail: detail(t("state-preparing-detail")) };
  if (at.stage === "counting_down") return { kind: "warn", word: String(at.left_s), detail: detail(t("state-counting-detail")) };
  if (at.stage === "unanswered") return { kind: "warn", word: t("state-waiting"), detail: detail(t("state-waiting-node", { place: at.place, seconds: at.since_s })) };
  if (at.stage === "holding") return { kind: "look", word: t("state-standby"), clock: clock(at.triggers, at.asked), detail: detail(t("state-standby-detail")), share: share(at.triggers, at.asked) };
  if (at.stage === "awaiting_edge") return { kind: "warn", word: t("state-waiting"), detail: detail(at.edge.rising ? t("state-waiting-rising", { line: at.edge.line }) : t("state-waiting-falling", { line: at.edge.line })) };
  if (at.stage === "stopping") return { kind: "warn", word: t("state-stopping"), detail: detail(t("state-stopping-detail")) };
  if (!at.triggers) return { kind: "warn", word: t("state-starting"), detail: detail(t("state-starting-detail")) };
  const [kind, word] = wish.dry_run ? ["look", t("state-dry-run")] : ["live", t("state-recording")];
  return { kind, word, clock: clock(at.triggers, at.asked), detail: detail(t("state-frames", { n: at.frames })), share: share(at.triggers, at.asked) };
}

/** Frames lost so far by cameras of all nodes, each as {id, lost, remark}; null while no train runs. */
export function losses() {
  const running = nodes().filter(({ last }) => last?.session && !last.session.outcome && last.session.triggers);
  if (!running.length) return null;
  return running.flatMap(({ last, status }) =>
    last.session.cameras.map((camera) => ({ id: camera.id, lost: lossOf(last, camera.id), remark: remarkOf(camera, status) })));
}

/** Of a camera whose frames stay away. A node that does not answer says nothing about its cameras. */
function remarkOf(camera, status) {
  if (!status) return "no-news";
  return camera.silent ? "silent" : null;
}

/** What has become of the frames: while a train runs so far, later the verdict. */
export function verdict() {
  const lost = losses();
  if (!lost || (!told.capture?.running && !sessionsUnderWay().length)) {
    const busy = told.capture?.running || sessionsUnderWay().length > 0;
    return busy ? soFar() : (lastVerdict() ?? { kind: "", word: "", detail: t("result-none") });
  }
  const dry = sessionsUnderWay().some((session) => session.dry_run);
  const sum = lost.reduce((total, camera) => total + camera.lost, 0);
  const lines = lost.filter((camera) => camera.lost || camera.remark)
    .map(({ id, lost: frames, remark }) => t(`result-camera-${remark ?? "lost"}`, { camera: id, n: frames }));
  if (dry) lines.push(t("result-nothing"));
  const before = soFar().detail;
  if (before) lines.push(before);
  return { so_far: true, kind: sum ? "bad" : "good", word: sum ? t("result-lost", { n: sum }) : t("result-no-loss"), detail: lines.join("\n") };
}

/** Between takes: what the takes before have come to. */
function soFar() {
  const takes = told.capture?.running ? told.capture.takes : [];
  return { kind: "", word: "", detail: takes.map((take) => `${take.name}: ${wordOf("verdict", take.verdict)}`).join("\n") };
}

/** A word in letters as large as it is seen whole in. */
function large(element, word) {
  text(element, word);
  element.style.setProperty("--letters", word.length || 1);
}

export function showStage() {
  const now = state();
  $("state").className = now.kind;
  large($("word"), now.word);
  text($("clock"), now.clock ?? "");
  text($("detail"), now.detail.trim());
  $("progress").hidden = now.share == null;
  $("progress-bar").style.width = `${Math.min(100, 100 * (now.share ?? 0))}%`;
  const result = verdict();
  $("verdict").className = result.kind;
  $("verdict").toggleAttribute("data-so-far", Boolean(result.so_far));
  text($("verdict-of"), result.word ? (result.so_far ? t("result-so-far") : t("result-last")) : "");
  large($("verdict-word"), result.word);
  text($("verdict-detail"), result.detail.trim());
  document.title = `${now.word} – fourdbody`;
  return { now, result };
}
