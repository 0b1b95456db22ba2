// The first line: the nodes with their devices, disks, workers, who is logged in, and the language.

import { $, make, span, text } from "./elements.js";
import { LATE_S, cameraProblem, disks, nodes, told } from "./told.js";
import { choose, language, languages, number, onLanguage, t } from "./words.js";

export function showHeader() {
  text($("rig"), `${told.status.rig}, ${number(told.status.trigger_rate_hz)} Hz`);
  showDevices();
  showDisk();
  showWorkers();
}

function showDevices() {
  const entries = nodes().flatMap((node) => {
    const { name, status, age_s, problem } = node;
    if (!status) {
      const label = Number.isFinite(age_s) ? t("device-gone-for", { name, time: span(age_s) }) : t("device-gone", { name });
      return [{ label, kind: "bad", title: problem ?? label }];
    }
    const bad = status.cameras.flatMap((camera) => cameraProblem(node, camera) ?? []);
    const hsu = status.hsu.problem;
    const old = age_s > LATE_S ? t("device-old", { time: span(age_s) }) : "";
    const answer = { name, good: status.cameras.length - bad.length, all: status.cameras.length };
    const label = (hsu ? t("device-no-hsu", answer) : t("device-hsu", answer)) + old;
    const kind = bad.length || hsu ? "bad" : old ? "soft" : "good";
    const told = [...bad, ...(hsu ? [hsu] : [])].join("\n");
    const notices = status.session && !status.session.outcome ? (status.session.notices ?? []) : [];
    const said = [...status.warnings, ...notices];
    const warnings = said.length ? [{ label: t("warnings", { n: said.length }), kind: "soft", title: said.join("\n") }] : [];
    return [{ label, kind, title: told || t("device-title", { name }) }, ...warnings];
  });
  const list = $("devices");
  entries.forEach(({ label, kind, title }, i) => {
    const item = list.children[i] ?? list.appendChild(make("li"));
    item.className = kind;
    item.title = title;
    text(item, label);
  });
  while (list.childElementCount > entries.length) list.lastElementChild.remove();
}

function showDisk() {
  const left = disks();
  text($("disk"), t("disk-left", { disks: left.map(({ name, seconds }) => `${name} ${span(seconds)}`).join(", ") }));
  const any = (grade) => left.some((node) => node.grade === grade);
  $("disk").className = any("bad") ? "bad" : any("fair") ? "warn" : "";
}

function showWorkers() {
  const workers = nodes().flatMap(({ name, status }) => (status?.worker ? [{ name, ...status.worker }] : []));
  text($("workers"), workers.map(({ name, line }) => t("worker", { name, line })).join("; "));
  $("workers").className = workers.some(({ running, set_aside }) => !running || set_aside.length) ? "warn" : "";
  const aside = workers.flatMap(({ set_aside }) => set_aside.map(([session, reason]) => `${session}: ${reason}`));
  $("workers").title = [$("workers").textContent, ...aside].join("\n");
}

$("language").append(...languages().map((tag) => make("option", { value: tag, textContent: tag.toUpperCase() })));
onLanguage(() => ($("language").value = language()));
$("language").addEventListener("change", () => {
  choose($("language").value);
  // The next key is for the console again.
  $("language").blur();
});
