// The body of all cameras as the nodes reconstruct it while cameras run, with how old it is and what of it is not seen.

import { addView, shown } from "./body-panel.js";
import { CloudView } from "./cloud-view.js";
import { $, text } from "./elements.js";
import { Refused, node } from "./node-client.js";
import { camerasRun, nodes, told } from "./told.js";
import { number, t } from "./words.js";

/** A body that is older is shown in grey, and after some seconds more not at all. */
const OLD_MS = 1000;
const GONE_MS = 5000;
/** A camera of which less becomes points is named. */
const POOR = 0.7;

const section = $("live-body");
const canvas = $("live-canvas");
const view = new CloudView(canvas);
let last = null;
/** Since when the cameras run, by the page's clock. */
let running = null;
addView("live", view);

const shares = (cameras) => cameras.map(({ camera, lit, points, refused }) => ({ camera, share: lit ? points / lit : 0, lit, refused }));

/** The line below the body. */
function said({ facts }, age_ms) {
  const poor = shares(facts.cameras).filter(({ share, lit, refused }) => refused || (lit && share < POOR));
  const of = poor.map(({ camera, share, refused, lit }) =>
    (!refused ? t("live-share", { camera, share: Math.round(100 * share) }) : lit ? t("live-uncertain", { camera }) : t("live-nobody", { camera })));
  const seconds = number(age_ms / 1000, 1);
  const age = age_ms > OLD_MS ? t("live-old", { age: seconds }) : t("live-delay", { age: seconds });
  const all = nodes().reduce((sum, { last }) => sum + (last?.cameras.length ?? 0), 0);
  return [t("live-facts", { seen: facts.cameras.length, n: all, rate: number(facts.frame_sets_per_s, 1), age }), ...of].join(" · ");
}

/** Why there is no body. */
function whyNone() {
  if (told.noBody) return t("live-none", { why: told.noBody });
  if (!running) return t("live-none-still");
  return performance.now() - running > GONE_MS ? t("live-none-busy") : t("live-none-yet");
}

function show() {
  running = camerasRun() ? (running ?? performance.now()) : null;
  const age_ms = last ? last.facts.age_ms + performance.now() - last.at : Infinity;
  const gone = age_ms > GONE_MS;
  if (gone && view.points) view.show([]);
  section.classList.toggle("none", gone);
  section.classList.toggle("old", age_ms > OLD_MS);
  text($("live-detail"), gone ? whyNone() : said(last, age_ms));
}

/** Waits for the next frame set and shows it; throws where there will be none. */
async function next() {
  const answer = await node.live(last?.facts.number ?? 0);
  told.noBody = null;
  if (!answer) return;
  const first = !last || section.classList.contains("none");
  last = { facts: answer.facts, at: answer.at };
  const points = view.show([answer.points], !first);
  canvas.dataset.points = String(points);
  view.onDraw = () => {
    if (!last || canvas.dataset.number === String(last.facts.number)) return;
    canvas.dataset.number = String(last.facts.number);
    canvas.dataset.cameras = String(last.facts.cameras.length);
    canvas.dataset.light_to_screen_ms = String(last.facts.age_ms + performance.now() - last.at);
  };
  show();
}

/** Shows the body for as long as the page is open and logged in. */
export async function showLiveBody(isOpen) {
  setInterval(show, 250);
  for (;;) {
    let pause_ms = 0;
    try {
      // Nodes make no body that nobody sees: in the place of one may be a take's.
      if (isOpen() && !document.hidden && shown() === "live") await next();
      else pause_ms = 300;
    } catch (error) {
      // Without a calibration there will be none until the node is started anew.
      const never = error instanceof Refused && error.status === 409;
      if (never) told.noBody = error.message;
      pause_ms = never ? 10000 : 1000;
    }
    await new Promise((resolve) => setTimeout(resolve, pause_ms));
  }
}
