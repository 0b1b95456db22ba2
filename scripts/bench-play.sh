#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# What it costs a browser to play ten seconds at 120 Hz: the report's page, and the console's player, which a node serves out of
# a worker's results. The frame sets are the demo's phase maps, again and again (hard links). Figures in
# target/bench-play/summary.json. Settings: FRAME_SETS (1200), RESULT, SESSION (the demo's), SEEKS (50). BUSY=1: the node's
# process has ordinary priority, for a machine that others use: at idle priority it would measure these.
set -euo pipefail
cd "$(dirname "$0")/.."
bin=target/release
out=target/bench-play
sets=${FRAME_SETS:-1200}
seeks=${SEEKS:-50}
result=${RESULT:-target/demo/result}
session=${SESSION:-target/demo/sessions/demo}
port=7857
. scripts/laboratory.sh
rm -rf "$out/node" "$out"/*.json "$out/page.html"
mkdir -p "$out/node/sessions" "$out/node/results/walk/phases"

step "$sets frame sets of the results of $result"
cp -a "$session" "$out/node/sessions/walk"
python3 - "$result" "$out/node" "$sets" "$port" <<'PY'
import json, os, sys
from pathlib import Path
result, node, sets, port = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
walk = node / "results/walk"
summary = json.loads((result / "summary.json").read_text())
known = summary["triggers"]
summary["triggers"] = [known[i % len(known)] | {"trigger": i} for i in range(sets)]
(walk / "summary.json").write_text(json.dumps(summary))
for name in ("calibration.json", "reconstruct.json"):
    os.link(result / name, walk / name)
for i in range(sets):
    trigger = known[i % len(known)]["trigger"]
    for camera in result.glob(f"phases/*_{trigger:06}.phase"):
        os.link(camera, walk / "phases" / f"{camera.stem.rsplit('_', 1)[0]}_{i:06}.phase")
job = {"session": "walk", "session_id": summary["session"]["id"], "stage": "done", "done": sets, "of": sets, "ended_ns": 1}
(walk / "job.json").write_text(json.dumps(job))
text = Path("config/node-a.toml").read_text()
text = text.replace("127.0.0.1:7401", f"127.0.0.1:{port}").replace("/var/lib/fourdbody/sessions", "sessions")
text = text.replace("reserve_mib = 4096", "reserve_mib = 1").replace("192.168.", "127.57.")
(node / "node.toml").write_text(text + '\n[worker]\nresults = "results"\n')
PY
cp config/rig.toml "$out/node/rig.toml"

step "the report's page"
begin=$(date +%s)
$bin/fourdbody report "$out/node/sessions/walk" --clouds "$out/node/results/walk" --play --out "$out/page.html" --json >"$out/report.json"
echo "$(($(date +%s) - begin))" >"$out/report.s"
python3 scripts/play_in_browser.py "file://$PWD/$out/page.html" "$sets" "$seeks" | tee "$out/page.json"

step "the console's player"
mkdir -p "$out/path"
printf '#!/bin/sh\nshift 2\nexec "$@"\n' >"$out/path/chrt"
chmod +x "$out/path/chrt"
with=$PATH
[ -z "${BUSY:-}" ] || with=$PWD/$out/path:$PATH
PATH=$with $bin/fourdbody node --config "$out/node/node.toml" 2>"$out/node.log" &
children+=($!)
wait_for 60 curl -sf "http://127.0.0.1:$port/api/v1/sessions/walk/frame-sets"
sleep 22 # its process ends, so that the page has to wait for a new one
python3 scripts/play_in_browser.py "http://127.0.0.1:$port/play.html?session=walk" "$sets" "$seeks" | tee "$out/console.json"
close_laboratory

python3 - "$out" "$sets" "$(git rev-parse HEAD)" <<'PY'
import json, os, platform, sys
out, sets, commit = sys.argv[1], int(sys.argv[2]), sys.argv[3]
read = lambda name: json.load(open(f"{out}/{name}.json"))
summary = {"commit": commit, "machine": f"{platform.machine()}, {os.cpu_count()} cores", "seed": 7, "frame_sets": sets, "ordinary_priority": bool(os.environ.get("BUSY")),
           "page_mib": round(read("report")["bytes"] / 2**20, 1), "page_made_s": int(open(f"{out}/report.s").read())}
summary |= {f"{name}_{key}": value for name in ("page", "console") for key, value in read(name).items()}
json.dump(summary, open(f"{out}/summary.json", "w"), indent=2, sort_keys=True)
print(json.dumps(summary, indent=2, sort_keys=True))
PY
