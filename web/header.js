// The first line: the nodes with their devices, disks, workers, and who is logged in.

import { $, count, make, span, text } from "./elements.js";
import { LATE_S, cameraProblem, disks, nodes, told } from "./told.js";

export function showHeader() {
  text($("rig"), `${told.status.rig}, ${told.status.trigger_rate_hz} Hz`);
  showDevices();
  showDisk();
  showWorkers();
}

function showDevices() {
  const entries = nodes().flatMap((node) => {
    const { name, status, age_s, problem } = node;
    if (!status) {
      const label = `node ${name}: ${Number.isFinite(age_s) ? `gone for ${span(age_s)}` : "gone"}`;
      return [{ label, kind: "bad", title: problem ?? label }];
    }
    const bad = status.cameras.flatMap((camera) => cameraProblem(node, camera) ?? []);
    const hsu = status.hsu.problem;
    const old = age_s > LATE_S ? `, no news for ${span(age_s)}` : "";
    const label = `${name} ${status.cameras.length - bad.length} of ${status.cameras.length}${hsu ? ", no HSU" : ", HSU"}${old}`;
    const kind = bad.length || hsu ? "bad" : old ? "soft" : "good";
    const told = [...bad, ...(hsu ? [hsu] : [])].join("\n");
    const notices = status.session && !status.session.outcome ? (status.session.notices ?? []) : [];
    const said = [...status.warnings, ...notices];
    const warnings = said.length ? [{ label: count(said.length, "warning"), kind: "soft", title: said.join("\n") }] : [];
    return [{ label, kind, title: told || `node ${name}: cameras that answer, and the link to the HSU` }, ...warnings];
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
  text($("disk"), `disk ${left.map(({ name, seconds }) => `${name} ${span(seconds)}`).join(", ")}`);
  const any = (grade) => left.some((node) => node.grade === grade);
  $("disk").className = any("bad") ? "bad" : any("fair") ? "warn" : "";
}

function showWorkers() {
  const workers = nodes().flatMap(({ name, status }) => (status?.worker ? [{ name, ...status.worker }] : []));
  text($("workers"), workers.map(({ name, line }) => `processing on ${name}: ${line}`).join("; "));
  $("workers").className = workers.some(({ running, set_aside }) => !running || set_aside.length) ? "warn" : "";
  const aside = workers.flatMap(({ set_aside }) => set_aside.map(([session, reason]) => `${session}: ${reason}`));
  $("workers").title = [$("workers").textContent, ...aside].join("\n");
}
