// State and verdict in letters that are read from three metres.

import { $, count, text } from "./elements.js";
import { asked } from "./form.js";
import { GONE_S, LATE_S, cannotRecord, isInPreview, lossOf, nodes, problems, sessionsUnderWay, silence_s, told } from "./told.js";
import { lastVerdict } from "./verdict.js";

/** Triggers as seconds. */
function clock(triggers, asked) {
  const rate = told.status.trigger_rate_hz;
  const seconds = (triggers / rate).toFixed(1);
  return asked ? `${seconds} of ${(asked / rate).toFixed(1)} s` : `${seconds} s`;
}

/** Where everything stands: {kind, word, clock, detail, share}. */
export function state() {
  if (silence_s() > GONE_S) return { kind: "bad", word: "NO ANSWER", detail: `from node ${told.status.node}: nothing here is current` };
  if (silence_s() > LATE_S) return { kind: "", word: "NO NEWS", detail: `from node ${told.status.node} for ${Math.floor(silence_s())} s` };
  const trouble = problems();
  const more = trouble.length ? [trouble.join("\n")] : [];
  const capture = told.capture;
  if (capture?.running) return underWay(capture, more);
  const [session] = sessionsUnderWay();
  if (session) {
    const running = session.triggers > 0;
    if (session.held) return { kind: "look", word: "STANDBY", detail: `session ${session.name}, begun elsewhere; nothing is recorded yet` };
    const detail = [`session ${session.name}, begun elsewhere`, ...more].join("\n");
    if (!running) return { kind: "warn", word: "PREPARING", detail };
    const [kind, word] = session.dry_run ? ["look", "DRY RUN"] : ["live", "RECORDING"];
    return { kind, word, clock: clock(session.triggers, session.triggers_asked), detail, share: share(session.triggers, session.triggers_asked) };
  }
  const missing = cannotRecord(asked());
  if (missing) return { kind: "bad", word: "NOT READY", detail: [missing, ...trouble.filter((one) => one !== missing)].join("\n") };
  const cameras = nodes().reduce((sum, { status }) => sum + status.cameras.length, 0);
  const live = nodes().some(({ status }) => isInPreview(status)) ? "\nlive pictures; nothing is recorded" : "";
  return { kind: "good", word: "READY", detail: `${cameras} cameras and the HSU answer${live}` };
}

const share = (triggers, asked) => (asked ? triggers / asked : null);

function underWay(capture, more) {
  const at = capture.stage;
  const { takes, wish } = capture.series;
  const take = takes > 1 ? [`take ${capture.take} of ${takes}`] : [];
  const detail = (line) => [[...take, line].join(": "), ...more].join("\n");
  if (!at) return { kind: "warn", word: "PAUSE", detail: detail(`${count(capture.takes.length, "take")} done`) };
  if (at.stage === "preparing") return { kind: "warn", word: "PREPARING", detail: detail("cameras and HSU of all nodes; live pictures stop for a moment") };
  if (at.stage === "counting_down") return { kind: "warn", word: String(at.left_s), detail: detail("every node is ready") };
  if (at.stage === "unanswered") return { kind: "warn", word: "WAITING", detail: detail(`no status from ${at.place} for ${at.since_s} s; its session goes on`) };
  if (at.stage === "holding") return { kind: "look", word: "STANDBY", clock: clock(at.triggers, at.asked), detail: detail("nothing is recorded yet: press Record to keep these seconds"), share: share(at.triggers, at.asked) };
  if (at.stage === "awaiting_edge") return { kind: "warn", word: "WAITING", detail: detail(`for the start signal: a ${at.edge.rising ? "rising" : "falling"} edge of the HSU's input ${at.edge.line}`) };
  if (at.stage === "stopping") return { kind: "warn", word: "STOPPING", detail: detail("after the current trigger") };
  if (!at.triggers) return { kind: "warn", word: "STARTING", detail: detail("the cameras warm up") };
  const [kind, word] = wish.dry_run ? ["look", "DRY RUN"] : ["live", "RECORDING"];
  return { kind, word, clock: clock(at.triggers, at.asked), detail: detail(count(at.frames, "frame")), share: share(at.triggers, at.asked) };
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
  if (!status) return " (no news from its node)";
  return camera.silent ? " sends nothing" : "";
}

/** What has become of the frames: while a train runs so far, later the verdict. */
export function verdict() {
  const lost = losses();
  if (!lost || (!told.capture?.running && !sessionsUnderWay().length)) {
    const busy = told.capture?.running || sessionsUnderWay().length > 0;
    return busy ? soFar() : (lastVerdict() ?? { kind: "", word: "", detail: "no session yet" });
  }
  const dry = sessionsUnderWay().some((session) => session.dry_run);
  const sum = lost.reduce((total, camera) => total + camera.lost, 0);
  const lines = lost.filter((camera) => camera.lost || camera.remark)
    .map(({ id, lost: frames, remark }) => `camera ${id}${remark}: ${count(frames, "frame")} lost`);
  if (dry) lines.push("nothing is recorded");
  const before = soFar().detail;
  if (before) lines.push(before);
  return { so_far: true, kind: sum ? "bad" : "good", word: sum ? `${sum} LOST` : "NO LOSS", detail: lines.join("\n") };
}

/** Between takes: what the takes before have come to. */
function soFar() {
  const takes = told.capture?.running ? told.capture.takes : [];
  return { kind: "", word: "", detail: takes.map((take) => `${take.name}: ${take.verdict}`).join("\n") };
}

export function showStage() {
  const now = state();
  $("state").className = now.kind;
  text($("word"), now.word);
  text($("clock"), now.clock ?? "");
  text($("detail"), now.detail.trim());
  $("progress").hidden = now.share == null;
  $("progress-bar").style.width = `${Math.min(100, 100 * (now.share ?? 0))}%`;
  const result = verdict();
  $("verdict").className = result.kind;
  $("verdict").toggleAttribute("data-so-far", Boolean(result.so_far));
  text($("verdict-of"), result.word ? (result.so_far ? "so far" : "last session") : "");
  text($("verdict-word"), result.word);
  text($("verdict-detail"), result.detail.trim());
  document.title = `${now.word} – fourdbody`;
  return { now, result };
}
