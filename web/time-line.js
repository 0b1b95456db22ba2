// The time line of the session as it happens: losses of each camera, how full the ring is, and the disk.

import { $, span, text } from "./elements.js";
import { disks, lossOf, nodes, sessionsUnderWay } from "./told.js";
import { number, t } from "./words.js";

/** Samples of the session that is shown: {trigger, losses by camera, ring, ring_high}. It stays until the next begins. */
const shown = { id: null, asked: 0, name: "", samples: [], cameras: [] };
/** Of a session that runs until it is stopped, each second sample goes when there are so many. */
const SAMPLES_MAX = 4000;

const style = getComputedStyle(document.documentElement);
const colour = (name) => style.getPropertyValue(`--${name}`).trim();

/** How full the fullest ring is and was, of 1. */
function ring(sessions) {
  const fill = (frames) => Math.max(0, ...sessions.map((session) => frames(session) / Math.max(1, session.ring_capacity)));
  return { now: fill((session) => session.ring_frames), most: Math.min(1, fill((session) => session.ring_high_water_frames)) };
}

function sample() {
  const parts = nodes().filter(({ last }) => last?.session && !last.session.outcome);
  const current = sessionsUnderWay();
  if (!current.length) return finish();
  const [{ session_id, triggers_asked, name }] = current;
  if (shown.id !== session_id) Object.assign(shown, { id: session_id, asked: triggers_asked, name, samples: [], cameras: [] });
  const trigger = Math.max(...current.map((session) => session.triggers));
  if (!trigger || trigger === shown.samples.at(-1)?.trigger) return;
  const losses = new Map(parts.flatMap(({ last }) => last.session.cameras.map(({ id }) => [id, lossOf(last, id)])));
  for (const id of losses.keys()) if (!shown.cameras.includes(id)) shown.cameras.push(id);
  const filled = ring(current);
  shown.samples.push({ trigger, losses, ring: filled.now, most: filled.most });
  if (shown.samples.length > SAMPLES_MAX) shown.samples = shown.samples.filter((_, i) => i % 2);
}

/** What came between the last look and the end of the session. */
function finish() {
  const ended = nodes().flatMap(({ status }) => (status?.session?.session_id === shown.id && status.session.outcome ? [status.session] : []));
  const last = shown.samples.at(-1);
  const trigger = Math.max(0, ...ended.map((session) => session.triggers));
  if (!last || trigger <= last.trigger) return;
  const losses = new Map(ended.flatMap((session) => session.cameras.map(({ id, gaps }) => [id, gaps])));
  shown.samples.push({ ...last, trigger, losses });
}

const sum = (losses) => [...losses.values()].reduce((total, lost) => total + lost, 0);

export function showTimeLine() {
  sample();
  const last = shown.samples.at(-1);
  const left = disks().toSorted((a, b) => a.seconds - b.seconds)[0];
  text($("line-disk"), left ? span(left.seconds) : "–");
  $("line-disk").className = { bad: "bad", fair: "warn" }[left?.grade] ?? "";
  if (last) {
    const lost = sum(last.losses);
    text($("line-lost"), String(lost));
    $("line-lost").className = lost ? "bad" : "";
    text($("line-ring"), `${Math.round(100 * last.ring)} %`);
    $("line-ring").title = t("line-buffer-most", { most: Math.round(100 * last.most) });
    $("line-ring").className = last.ring >= 0.75 ? "bad" : last.ring >= 0.25 ? "warn" : "";
    const facts = { name: shown.name, trigger: last.trigger, asked: shown.asked, n: lost, most: Math.round(100 * last.most) };
    const what = shown.asked ? t("line-said-of", facts) : t("line-said", facts);
    if ($("line-canvas").ariaLabel !== what) $("line-canvas").ariaLabel = what;
  }
  $("line-canvas").dataset.samples = String(shown.samples.length);
  draw();
}

let drawing = false;
function draw() {
  if (drawing) return;
  drawing = true;
  requestAnimationFrame(() => {
    drawing = false;
    paint($("line-canvas"));
  });
}

function paint(canvas) {
  const scale = Math.min(window.devicePixelRatio || 1, 2);
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (canvas.width !== Math.round(width * scale)) canvas.width = Math.round(width * scale);
  if (canvas.height !== Math.round(height * scale)) canvas.height = Math.round(height * scale);
  const pen = canvas.getContext("2d");
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  pen.clearRect(0, 0, width, height);
  const size = Math.max(12, Math.min(17, height / 7));
  pen.font = `${size}px system-ui, "DejaVu Sans", sans-serif`;
  pen.textBaseline = "middle";
  const last = shown.samples.at(-1);
  if (!last) {
    pen.fillStyle = colour("soft");
    pen.fillText(t("line-empty"), 4, height / 2);
    return;
  }
  const begin = 4.2 * size;
  const end = shown.asked || last.trigger;
  const x = (trigger) => begin + (width - begin) * Math.min(1, trigger / end);
  const lanes = height * 0.6;
  const lane = lanes / Math.max(1, shown.cameras.length);
  shown.cameras.forEach((id, row) => paintLane(pen, id, { row, lane, x, begin, size }));
  paintRing(pen, { top: lanes + 3, height: height - lanes - size - 4, x, begin });
  pen.fillStyle = colour("soft");
  pen.fillText(t("line-buffer"), 2, lanes + (height - lanes - size) / 2);
  pen.fillText("0 s", begin, height - size / 2);
  const seconds = `${number(end / (nodes()[0]?.last?.trigger_rate_hz || 1), 1)} s`;
  pen.fillText(seconds, width - pen.measureText(seconds).width - 2, height - size / 2);
}

/** Green where every frame has come, red where some are lost. */
function paintLane(pen, id, { row, lane, x, begin, size }) {
  const y = row * lane;
  let before = { trigger: 0, lost: 0 };
  for (const { trigger, losses } of shown.samples) {
    const lost = losses.get(id) ?? 0;
    const bad = lost > before.lost;
    pen.fillStyle = bad ? "#ff5a4d" : "#2f6b48";
    // What is lost is seen, however short it was.
    pen.fillRect(x(before.trigger), bad ? y : y + lane * 0.25, Math.max(bad ? 3 : 0, x(trigger) - x(before.trigger)), bad ? lane - 1 : lane * 0.5);
    before = { trigger, lost };
  }
  // Where there is no room for every name, the first of each head stands.
  if (lane < size * 0.9 && row % 2) return;
  pen.fillStyle = before.lost ? colour("bad") : colour("soft");
  if (lane < size * 0.9) pen.font = `${Math.max(9, Math.min(size, 1.8 * lane))}px system-ui, "DejaVu Sans", sans-serif`;
  pen.fillText(lane < size * 0.9 ? id.split("_")[0] : id, 2, y + (lane < size * 0.9 ? lane : lane / 2), begin - 6);
  pen.font = `${size}px system-ui, "DejaVu Sans", sans-serif`;
}

function paintRing(pen, { top, height, x, begin }) {
  pen.fillStyle = "#161c22";
  pen.fillRect(begin, top, x(Infinity) - begin, height);
  let before = 0;
  for (const { trigger, ring } of shown.samples) {
    const high = Math.max(1, height * Math.min(1, ring));
    pen.fillStyle = ring >= 0.75 ? "#ff5a4d" : ring >= 0.25 ? colour("warn") : colour("accent");
    pen.fillRect(x(before), top + height - high, Math.max(1, x(trigger) - x(before)), high);
    before = trigger;
  }
}

new ResizeObserver(draw).observe($("line-canvas"));
