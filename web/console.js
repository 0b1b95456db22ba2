// The console of one node: everything it shows is what the API told it a moment ago.

import { CloudView } from "/cloud-view.js";
import { Gone, Refused, node } from "/node-client.js";

const POLL_MS = 400;
const GONE_MS = 1200;
const $ = (id) => document.getElementById(id);
const text = (element, value) => {
  if (element.textContent !== value) element.textContent = value;
};
const make = (tag, attributes = {}, ...children) => {
  const element = Object.assign(document.createElement(tag), attributes);
  element.append(...children);
  return element;
};

/** What was told last. `peers` are the other nodes with their status. */
const known = { status: null, peers: [], capture: null, role: "view" };
let seen = performance.now();
let asked = null; // why the last button did not do what it says

// ---- state in one word

/** All nodes as {name, status, problem}, this one first. */
const nodes = () => [
  { name: known.status.node, peer: "", status: known.status, problem: null },
  ...known.peers.map((peer) => ({ ...peer, peer: peer.name })),
];

/** What is wrong with a camera: a session notices within three triggers that it is silent, its driver some seconds later. */
function problemOf(status, camera) {
  const silent = status.session && !status.session.outcome && status.session.cameras.some((heard) => heard.id === camera.id && heard.silent);
  return camera.problem ?? (silent ? `camera ${camera.id} is silent` : null);
}

function problems() {
  const found = [];
  for (const { name, status, problem } of nodes()) {
    if (!status) {
      found.push(`node ${name}: ${problem}`);
      continue;
    }
    for (const camera of status.cameras) {
      const problem = problemOf(status, camera);
      if (problem) found.push(problem);
    }
    if (status.hsu.problem) found.push(`node ${name}: ${status.hsu.problem}`);
  }
  return found;
}

const sessionsUnderWay = () =>
  nodes().filter(({ status }) => status && status.session && !status.session.outcome).map(({ status }) => status.session);

/** Where everything stands: {kind, word, detail, share}. */
function stage() {
  const capture = known.capture;
  const trouble = problems();
  if (capture?.running) return underWay(capture, trouble);
  const [session] = sessionsUnderWay();
  if (session) {
    const phase = known.status.phase;
    const word = phase === "running" ? (session.dry_run ? "DRY RUN" : "RECORDING") : "PREPARING";
    return { kind: word === "PREPARING" ? "warn" : "live", word, detail: `session ${session.name}, begun elsewhere\ntrigger ${session.triggers}${trouble.length ? `\n${trouble.join("\n")}` : ""}`, share: shareOf(session) };
  }
  // The verdict stays until the next session: it is what the operator waits for. What is wrong now stands beside it.
  const last = capture ? ended(capture) : known.status.session?.outcome ? endedHere(known.status.session) : null;
  if (last && trouble.length) return { ...last, kind: last.kind === "good" ? "warn" : last.kind, detail: `${last.detail.trim()}\nnot ready for the next: ${trouble.join("; ")}` };
  if (last) return last;
  if (trouble.length) return { kind: "bad", word: "NOT READY", detail: trouble.join("\n") };
  return { kind: "good", word: "READY", detail: "every camera and the HSU answer on all nodes" };
}

function underWay(capture, trouble) {
  const at = capture.stage;
  const dry = capture.series.wish.dry_run;
  const take = capture.series.takes > 1 ? `take ${capture.take} of ${capture.series.takes}\n` : "";
  const told = trouble.length ? `\n${trouble.join("\n")}` : "";
  if (!at) return { kind: "warn", word: "PAUSE", detail: `${take}${capture.takes.length} takes done${told}` };
  if (at.stage === "preparing") return { kind: "warn", word: "PREPARING", detail: `${take}cameras and HSU of all nodes${told}` };
  if (at.stage === "counting_down") return { kind: "warn", word: String(at.left_s), detail: `${take}every node is ready${told}` };
  if (at.stage === "unanswered") return { kind: "warn", word: "WAITING", detail: `${take}no status from ${at.place} for ${at.since_s} s; its session goes on${told}` };
  if (at.stage === "stopping") return { kind: "live", word: "STOPPING", detail: take + told };
  const rate = known.status.trigger_rate_hz;
  const seconds = (at.triggers / rate).toFixed(1);
  const of = at.asked ? ` of ${(at.asked / rate).toFixed(1)} s` : " s";
  const gaps = at.gaps ? `${at.gaps} GAPS` : "no gaps";
  const word = preview(capture) ? "PREVIEW" : dry ? "DRY RUN" : "RECORDING";
  return { kind: at.gaps && !preview(capture) ? "bad" : "live", word: `${word} ${seconds}${of}`, detail: `${take}${at.frames} frames, ${gaps}${told}`, share: at.asked ? at.triggers / at.asked : null };
}

/** A dry run without an end is what the preview button asks for. */
const preview = (capture) => capture.series.wish.dry_run && !capture.series.wish.duration_s && !capture.series.wish.triggers;
const shareOf = (session) => (session.triggers_asked ? session.triggers / session.triggers_asked : null);

function ended(capture) {
  if (capture.fault) return { kind: "bad", word: "FAILED", detail: capture.fault.message };
  if (preview(capture)) return { kind: "good", word: "READY", detail: "the preview has ended; nothing was recorded" };
  const words = capture.takes.map((take) => take.verdict);
  const worst = ["aborted", "incomplete", "unconfirmed", "partial", "complete"].find((word) => words.includes(word)) ?? "aborted";
  const kind = { complete: "good", partial: "warn", unconfirmed: "warn", incomplete: "warn", aborted: "bad" }[worst];
  const last = capture.takes.at(-1);
  const name = capture.takes.map((take) => take.name).join(", ");
  const dry = capture.series.wish.dry_run ? "dry run, nothing was recorded\n" : "";
  const frames = last ? last.nodes.flatMap(({ session }) => session.cameras).reduce((sum, camera) => sum + camera.frames, 0) : 0;
  return { kind, word: worst.toUpperCase(), detail: `${dry}${name}: ${frames} frames\n${last ? last.nodes.map(causes).filter(Boolean).join("\n") : ""}` };
}

/** Why a node's session is not complete. */
function causes({ node: name, session }) {
  const outcome = session.outcome;
  if (outcome?.failed) return `node ${name}: ${outcome.failed.message}`;
  const verdict = outcome?.recorded;
  if (!verdict) return `node ${name}: no verdict`;
  const lines = verdict.cameras
    .filter((camera) => Object.keys(camera.gaps).length)
    .map((camera) => `${camera.camera}: ${Object.entries(camera.gaps).map(([cause, count]) => `${count} ${cause.replaceAll("_", " ")}`).join(", ")}`);
  if (verdict.aborted) lines.push(`ended early: ${verdict.aborted}`);
  return lines.length ? `node ${name}: ${lines.join("; ")}` : "";
}

function endedHere(session) {
  const verdict = session.outcome.recorded;
  if (!verdict) return { kind: "bad", word: "FAILED", detail: session.outcome.failed.message };
  const kind = { complete: "good", unconfirmed: "warn", incomplete: "warn", aborted: "bad" }[verdict.status] ?? "bad";
  return { kind, word: verdict.status.toUpperCase(), detail: `${session.name}, at this node\n${causes({ node: known.status.node, session })}` };
}

// ---- showing

function show() {
  const now = stage();
  $("stage").className = now.kind;
  text($("word"), now.word);
  text($("detail"), now.detail.trim());
  $("progress").hidden = now.share == null;
  $("progress-bar").style.width = `${100 * (now.share ?? 0)}%`;
  document.title = `${now.word} – fourdbody`;
  text($("rig"), `fourdbody ${known.status.rig}, ${known.status.trigger_rate_hz} Hz`);
  showDevices();
  showDisk();
  showWorkers();
  const running = Boolean(known.capture?.running) || sessionsUnderWay().length > 0;
  const may = known.role !== "view";
  for (const id of ["start", "look", "dry"]) $(id).disabled = running || !may;
  for (const id of ["stop", "abort"]) $(id).disabled = !running || !may;
  text($("capture-problem"), asked ?? "");
}

function showDevices() {
  const list = $("devices");
  const entries = nodes().flatMap(({ name, status, problem }) => {
    if (!status) return [{ label: `node ${name}`, problem }];
    const cameras = status.cameras.filter((camera) => camera.problem);
    const own = [{ label: `node ${name}: ${status.phase}`, problem: null }, { label: `HSU at ${name}`, problem: status.hsu.problem }];
    const good = status.cameras.length - cameras.length;
    return [...own, { label: `${good} of ${status.cameras.length} cameras`, problem: cameras.length ? cameras.map((camera) => camera.problem).join("; ") : null },
      ...status.warnings.map((warning) => ({ label: warning, problem: null, soft: true }))];
  });
  list.replaceChildren(...entries.map(({ label, problem, soft }) =>
    make("li", { className: problem ? "bad" : soft ? "" : "good", title: problem ?? label, textContent: label.length > 70 ? `${label.slice(0, 68)}…` : label })));
}

function showDisk() {
  const left = nodes().flatMap(({ name, status }) => {
    const judged = status?.judgements.find((judgement) => judgement.name === "disk_time_left");
    return judged ? [{ name, minutes: judged.value / 60, grade: judged.grade }] : [];
  });
  text($("disk"), `disk: ${left.map(({ name, minutes }) => `${name} ${minutes < 90 ? `${minutes.toFixed(minutes < 10 ? 1 : 0)} min` : `${(minutes / 60).toFixed(1)} h`}`).join(", ")}`);
  const any = (grade) => left.some((node) => node.grade === grade);
  $("disk").className = any("bad") ? "bad" : any("fair") ? "warn" : "";
}

function showWorkers() {
  const workers = nodes().flatMap(({ name, status }) => (status?.worker ? [{ name, ...status.worker }] : []));
  text($("workers"), workers.map(({ name, line }) => `worker of ${name}: ${line}`).join("\n"));
  $("workers").className = workers.some(({ running, set_aside }) => !running || set_aside.length) ? "warn" : "";
  $("workers").title = workers.flatMap(({ set_aside }) => set_aside.map(([session, reason]) => `${session}: ${reason}`)).join("\n");
}

// ---- previews

const cameras = new Map();

function cameraBox(id) {
  const picture = make("img", { className: "picture", alt: `camera ${id}` });
  picture.removeAttribute("src");
  const rows = Object.fromEntries(["saturated", "modulation", "focus", "trigger"].map((key) => [key, make("dd", { textContent: "–" })]));
  const list = make("dl");
  for (const [key, value] of Object.entries(rows)) list.append(make("dt", { textContent: key }), value);
  const problem = make("p", { className: "problem" });
  const box = make("figure", { className: "camera", id: `camera-${id}` }, picture,
    make("figcaption", {}, make("p", { className: "title" }, make("span", { textContent: id })), problem, list));
  return { box, picture, rows, problem, number: 0, url: null, best: 0 };
}

function placeCameras() {
  const wanted = nodes().flatMap(({ peer, status }) => (status ? status.cameras.map((camera) => ({ peer, camera, problem: problemOf(status, camera) })) : []));
  for (const { peer, camera, problem } of wanted) {
    if (!cameras.has(camera.id)) cameras.set(camera.id, { ...cameraBox(camera.id) });
    const shown = cameras.get(camera.id);
    shown.peer = peer;
    shown.box.classList.toggle("bad", Boolean(problem));
    text(shown.problem, problem ?? "");
  }
  // A column a head: the upper cameras above the lower ones.
  const order = (id) => (id.endsWith("_low") ? `1${id}` : `0${id}`);
  const ids = [...cameras.keys()].sort((a, b) => order(a).localeCompare(order(b)));
  if ($("previews").childElementCount !== ids.length) $("previews").replaceChildren(...ids.map((id) => cameras.get(id).box));
}

async function refreshPreviews(peer) {
  for (const fact of await node.previews(peer)) {
    const shown = cameras.get(fact.camera);
    if (!shown) continue;
    if (fact.light) {
      grade(shown.rows.saturated, `${(100 * fact.light.saturated).toFixed(2)} %`, fact.grades.saturated);
      grade(shown.rows.modulation, `${fact.light.modulation_dn.toFixed(0)} DN, ${(100 * fact.light.contrast).toFixed(0)} %`, fact.grades.modulation);
      shown.best = Math.max(shown.best, fact.light.focus);
      grade(shown.rows.focus, `${fact.light.focus.toFixed(2)} (best ${shown.best.toFixed(2)})`, "");
      grade(shown.rows.trigger, fact.age_s < 3 ? `${fact.trigger}` : `${fact.trigger}, ${fact.age_s.toFixed(0)} s ago`, "");
    }
    if (fact.number && fact.number !== shown.number) {
      const blob = await node.picture(peer, fact.camera);
      if (!blob) continue;
      const url = URL.createObjectURL(blob);
      shown.picture.src = url;
      if (shown.url) URL.revokeObjectURL(shown.url);
      Object.assign(shown, { url, number: fact.number });
    }
  }
}

function grade(element, value, kind) {
  text(element, value);
  element.className = { good: "good", fair: "warn", bad: "bad" }[kind] ?? "";
}

// ---- sessions and the quick look

const view = new CloudView($("cloud-canvas"));
const look = { session: null, trigger: null, wanted: null };

async function refreshSessions() {
  const found = new Map();
  for (const { name, peer, status } of nodes()) {
    if (!status) continue;
    const entries = await node.sessions(peer).catch(() => []);
    for (const entry of entries) {
      const session = found.get(entry.name) ?? { ...entry, parts: [] };
      session.parts.push({ node: name, entry });
      found.set(entry.name, session);
    }
  }
  const rows = [...found.values()].sort((a, b) => b.created_ns - a.created_ns).slice(0, 50).map(sessionRow);
  $("session-rows").replaceChildren(...rows);
}

function sessionRow(session) {
  const expected = nodes().length;
  const now = sessionsUnderWay().some(({ name }) => name === session.name);
  const words = session.parts.map(({ entry }) => (entry.verdict ? entry.verdict.status : "unfinished"));
  if (session.parts.length < expected) words.push("one node only");
  const worst = ["aborted", "unfinished", "one node only", "incomplete", "unconfirmed", "complete"].find((word) => words.includes(word));
  const word = now ? "recording" : worst;
  const kind = { complete: "good", unconfirmed: "warn", incomplete: "warn", recording: "warn" }[word] ?? "bad";
  const triggers = Math.max(...session.parts.map(({ entry }) => entry.verdict?.triggers ?? 0));
  const button = make("button", { type: "button", textContent: "look", onclick: () => openLook(session.name) });
  button.setAttribute("aria-label", `quick look at ${session.name}`);
  return make("tr", {},
    make("td", { textContent: session.name, title: session.note ?? "" }),
    make("td", { textContent: new Date(session.created_ns / 1e6).toLocaleString() }),
    make("td", { textContent: session.subject ?? "" }),
    make("td", { textContent: String(triggers) }),
    make("td", { className: kind, textContent: word }),
    make("td", {}, button));
}

async function openLook(session) {
  Object.assign(look, { session, trigger: null, wanted: session });
  text($("cloud-title"), `Quick look: ${session}`);
  for (const { peer, status } of nodes()) if (status) await node.askLook(peer, session).catch((error) => text($("cloud-detail"), error.message));
  await refreshLook();
}

async function refreshLook() {
  const session = look.wanted;
  if (!session) return;
  const states = [];
  for (const { name, peer, status } of nodes()) if (status) states.push({ name, peer, ...(await node.look(peer, session)) });
  const ready = states.filter((state) => state.triggers.length);
  const triggers = [...new Set(ready.flatMap((state) => state.triggers))].sort((a, b) => a - b);
  $("cloud-sets").replaceChildren(...triggers.map((trigger) => {
    const button = make("button", { type: "button", textContent: `trigger ${trigger}`, onclick: () => showCloud(ready, trigger) });
    button.setAttribute("aria-pressed", String(trigger === look.trigger));
    return button;
  }));
  const told = states.filter((state) => state.state !== "ready").map((state) => {
    if (state.state === "working") return `node ${state.name}: frame set ${state.done + 1} of ${state.of}`;
    if (state.state === "failed") return `node ${state.name}: ${state.reason}`;
    return `node ${state.name}: ${state.state.replaceAll("_", " ")}`;
  });
  if (told.length) text($("cloud-detail"), told.join("; "));
  const complete = states.length > 0 && states.every((state) => state.state === "ready");
  const first = triggers.find((trigger) => states.every((state) => state.triggers.includes(trigger)));
  if (look.trigger === null && first !== undefined) await showCloud(ready, first);
  if (complete) look.wanted = null;
}

async function showCloud(states, trigger) {
  const clouds = [];
  for (const state of states) if (state.triggers.includes(trigger)) clouds.push(await node.cloud(state.peer, look.session, trigger));
  const points = view.show(clouds);
  look.trigger = trigger;
  text($("cloud-detail"), view.works ? `trigger ${trigger}: ${points} points shown, from ${states.length} nodes; turn with the mouse or the arrow keys` : "this browser has no WebGL 2; see fourdbody view");
  for (const button of $("cloud-sets").children) button.setAttribute("aria-pressed", String(button.textContent === `trigger ${trigger}`));
  $("cloud-canvas").dataset.points = String(points);
}

// ---- what the operator does

function series(extra = {}) {
  const filled = (id) => $(id).value.trim() || null;
  const seconds = filled("seconds");
  return {
    wish: { name: filled("name"), subject: filled("subject"), note: filled("note"), duration_s: seconds ? Number(seconds) : null, countdown_s: Number(filled("countdown") ?? 0), partial: $("partial").checked, ...extra },
    takes: Number(filled("takes") ?? 1),
    pause_s: 0,
  };
}

async function act(doing) {
  asked = null;
  try {
    await doing();
  } catch (error) {
    asked = error.message;
  }
  await refresh();
}

const begin = () => act(() => node.begin(series()));
const dryRun = () => act(() => node.begin(series({ dry_run: true })));
const previewRun = () => act(() => node.begin({ wish: { dry_run: true, note: "preview" }, takes: 1 }));
const stop = () => act(() => node.stop());

$("capture").addEventListener("submit", (event) => {
  event.preventDefault();
  if (!$("start").disabled) begin();
});
$("stop").addEventListener("click", stop);
$("look").addEventListener("click", previewRun);
$("dry").addEventListener("click", () => $("capture").reportValidity() && dryRun());
$("abort").addEventListener("click", () => act(() => node.abort("aborted at the console")));
document.addEventListener("keydown", (event) => {
  if (event.target.matches("input, textarea") || event.ctrlKey || event.altKey || event.metaKey) return;
  const button = { r: "start", s: "stop", p: "look", d: "dry" }[event.key];
  if (button && !$("console").hidden) $(button).click();
});
$("login").addEventListener("submit", async (event) => {
  event.preventDefault();
  try {
    await node.login($("token").value);
    $("token").value = "";
    text($("login-problem"), "");
    await enter();
  } catch (error) {
    text($("login-problem"), error.message);
  }
});

// ---- the loops

async function refresh() {
  const [status, peers, capture] = await Promise.all([node.status(), node.peers(), node.capture()]);
  const before = known.capture;
  Object.assign(known, { status, peers, capture });
  seen = performance.now();
  placeCameras();
  show();
  if (before?.running && !capture?.running) {
    await refreshSessions();
    const last = capture?.takes?.at(-1);
    if (last && !last.dry_run) openLook(last.name);
  }
}

/** Does something again and again; what the node refuses is the end of the login, what it does not answer is told. */
async function forever(doing, period_ms) {
  for (;;) {
    try {
      if (!$("console").hidden) await doing();
    } catch (error) {
      if (error instanceof Refused && error.status === 401) leave();
      else if (!(error instanceof Gone) && !(error instanceof Refused)) console.error(error);
    }
    await new Promise((resolve) => setTimeout(resolve, period_ms));
  }
}

function watchConnection() {
  const silent = performance.now() - seen;
  const gone = !$("console").hidden && silent > GONE_MS + POLL_MS;
  $("gone").hidden = !gone;
  $("console").classList.toggle("stale", gone);
  if (gone) text($("gone"), `NODE ${known.status?.node ?? ""} IS GONE: nothing here is current (${(silent / 1000).toFixed(0)} s)`);
}

async function enter() {
  const identity = await node.identity();
  known.role = identity.role;
  text($("who"), `${identity.name} (${identity.role})`);
  $("login").hidden = true;
  $("console").hidden = false;
  await refresh();
  await refreshSessions();
}

function leave() {
  $("console").hidden = true;
  $("login").hidden = false;
  $("token").focus();
}

async function begun() {
  for (;;) {
    try {
      return await enter();
    } catch (error) {
      if (error instanceof Refused) return leave();
      await new Promise((resolve) => setTimeout(resolve, 1000));
    }
  }
}

await begun();
forever(refresh, POLL_MS);
forever(() => Promise.all(nodes().filter(({ status }) => status).map(({ peer }) => refreshPreviews(peer).catch(() => {}))), POLL_MS);
forever(refreshLook, 600);
forever(refreshSessions, 10000);
setInterval(watchConnection, 200);
