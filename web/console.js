// The console of one node: asks the nodes again and again, and has every part show what they told a moment ago.

import { showBody } from "./body-panel.js";
import { keepPictures, onAct, showControls } from "./controls.js";
import { $, span, text } from "./elements.js";
import { showExposure } from "./exposure.js";
import { showHeader } from "./header.js";
import { showLiveBody } from "./live-body.js";
import { Gone, Refused, node } from "./node-client.js";
import { openLook, refreshLook } from "./quick-look.js";
import { listen } from "./sound.js";
import { losses, showStage } from "./stage.js";
import { refreshTakes } from "./takes.js";
import { refreshPictures, showTiles } from "./tiles.js";
import { showTimeLine } from "./time-line.js";
import { GONE_S, LATE_S, nodes, silence_s, take, told } from "./told.js";
import { onLanguage, t } from "./words.js";

const POLL_MS = 300;

/** The take under way for which the live body was brought back. */
let liveFor = "";

/** Shows everything anew: ages grow although nothing is told. */
function show() {
  if ($("console").hidden || !told.status) return;
  const under_way = told.capture?.running && told.capture.stage ? `${told.capture.number}/${told.capture.take}` : "";
  if (under_way && under_way !== liveFor) showBody("live");
  liveFor = under_way;
  showHeader();
  showStage();
  showTiles();
  showTimeLine();
  showControls();
  showExposure();
  const lost = (losses() ?? []).reduce((sum, camera) => sum + camera.lost, 0);
  listen(told.capture, lost);
  watchConnection();
}

function watchConnection() {
  const silent = silence_s();
  const gone = silent > GONE_S;
  $("gone").hidden = silent <= LATE_S;
  $("gone").className = gone ? "bad" : "";
  $("console").classList.toggle("stale", silent > LATE_S);
  const news = t("silent", { node: told.status.node, time: span(silent) });
  text($("gone"), gone ? t("silent-long", { news: news.toUpperCase() }) : news);
}

/** Takes what a node answers, unless a question that was asked later has been answered before. */
const latest = { asked: 0, answered: {} };
async function learn(what, ask) {
  const number = ++latest.asked;
  const value = await ask();
  if (number < (latest.answered[what] ?? 0)) return;
  latest.answered[what] = number;
  take(what, value);
}

async function refreshCapture() {
  const before = told.capture;
  await learn("capture", node.capture);
  const taken = told.capture?.takes ?? [];
  const isNew = before && (before.number !== told.capture?.number ? taken.length > 0 : taken.length > before.takes.length);
  if (isNew || (before?.running && !told.capture?.running)) {
    show();
    await refreshTakes();
    const last = taken.at(-1);
    if (isNew && !last.dry_run) openLook(last.name);
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

const refresh = async () => {
  await Promise.all([learn("status", node.status), learn("capture", node.capture)]);
  show();
};

async function enter() {
  const identity = await node.identity();
  told.role = identity.role;
  text($("who"), `${identity.name} (${identity.role})`);
  $("logout").hidden = identity.via !== "cookie";
  take("peers", await node.peers());
  take("status", await node.status());
  take("capture", await node.capture());
  $("login").hidden = true;
  $("console").hidden = false;
  show();
  await refreshTakes();
}

function leave() {
  $("console").hidden = true;
  $("gone").hidden = true;
  $("login").hidden = false;
  $("token").focus();
}

/** The code of a link that logs in once (`#login=CODE`); it leaves the address bar before anything else happens. */
function takeCode() {
  const code = new URLSearchParams(location.hash.slice(1)).get("login");
  if (code !== null) history.replaceState(null, "", location.pathname + location.search);
  return code;
}

/** Logs in with a code. Where it does not work, an earlier login of this browser holds; else the form says why. */
async function useCode(code) {
  if (code === null) return;
  try {
    await node.loginByLink(code);
    text($("login-problem"), "");
  } catch (error) {
    if (error instanceof Gone) throw error;
    text($("login-problem"), error.message);
  }
}

$("login").addEventListener("submit", async (event) => {
  event.preventDefault();
  try {
    await node.login($("token").value);
    $("token").value = "";
    text($("login-problem"), "");
    await enter();
  } catch (error) {
    text($("login-problem"), error.message);
    $("token").select();
  }
});
$("logout").addEventListener("click", async () => {
  await node.logout().catch(() => {});
  leave();
});
onAct(() => refresh().catch(() => {}));
onLanguage(show);

async function begun(code) {
  for (;;) {
    try {
      await useCode(code);
      code = null;
      return await enter();
    } catch (error) {
      if (error instanceof Refused) return leave();
      await new Promise((resolve) => setTimeout(resolve, 1000));
    }
  }
}

// A link that is opened where the page is open already changes only what follows the hash sign.
addEventListener("hashchange", () => {
  const code = takeCode();
  if (code !== null) begun(code);
});
await begun(takeCode());
// Each asks for itself: a node that does not answer keeps nobody else's news away.
forever(() => learn("status", node.status), POLL_MS);
forever(() => learn("peers", node.peers), POLL_MS);
forever(refreshCapture, POLL_MS);
forever(() => Promise.all(nodes().filter(({ status }) => status).map(({ peer }) => refreshPictures(peer).catch(() => {}))), POLL_MS);
forever(keepPictures, 800);
showLiveBody(() => !$("console").hidden);
forever(refreshLook, 600);
forever(refreshTakes, 5000);
setInterval(show, 200);
