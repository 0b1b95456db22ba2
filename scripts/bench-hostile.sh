#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Do previews and hostile clients cost the recording a frame? One node with four cameras records twice, alone and under
# clients (scripts/hostile_clients.py); figures in target/bench-hostile/summary.json. Settings: RATE_HZ (60), DURATION (15 s).
set -euo pipefail
cd "$(dirname "$0")/.."
bin=target/release
out=target/bench-hostile
rate_hz=${RATE_HZ:-60}
duration=${DURATION:-15}
. scripts/laboratory.sh
rm -rf "$out"
mkdir -p "$out"

step "half a laboratory: four cameras of 1920 x 1200 at $rate_hz Hz, one node"
open_laboratory "$out/lab" --rig config/rig.toml --node a --sessions-dir "$out/sessions" --rate-hz "$rate_hz" \
    --first-address 127.0.79.11 --first-port 7701 --buffers 128
node=$(pgrep -f "fourdbody node --config $out/lab/node-a.toml")
cpu() { awk '{ print ($14 + $15) / 100 }' "/proc/$node/stat"; }

for kind in alone hostile; do
    step "$duration s, $kind"
    sleep 3 # the simulated cameras may be behind with their last frames
    before=$(cpu)
    if [ $kind = hostile ]; then
        # Not before the streams are there: on loopback Aravis' packet sockets take the clients' packets until their filter
        # is set, and the node refuses cameras that seem to send by themselves.
        (sleep 4 && nice -n 5 python3 scripts/hostile_clients.py 7701 $((duration - 5)) >"$out/clients.json") &
        clients=$!
    fi
    record "$out/$kind.json" --duration "$duration" --name $kind
    [ $kind = alone ] || wait $clients
    awk "BEGIN { print $(cpu) - $before }" >"$out/$kind.cpu"
    rm -rf "${out:?}/sessions/$kind"
done
$bin/fourdbody status --nodes "$nodes" --json >"$out/status.json"

python3 - "$out" "$rate_hz" "$duration" "$(git rev-parse HEAD)" <<'PY'
import json, sys
out, rate, duration, commit = sys.argv[1], float(sys.argv[2]), float(sys.argv[3]), sys.argv[4]
summary = {"commit": commit, "trigger_rate_hz": rate, "duration_s": duration}
for kind in ("alone", "hostile"):
    session = json.load(open(f"{out}/{kind}.json"))["nodes"][0]["session"]
    cameras = session["outcome"]["recorded"]["cameras"]
    summary[f"frames_{kind}"] = sum(camera["frames"] for camera in cameras)
    summary[f"gaps_{kind}"] = sum(sum(camera["gaps"].values()) for camera in cameras)
    summary[f"ring_high_water_frames_{kind}"] = session["ring_high_water_frames"]
    summary[f"total_p99_ms_{kind}"] = session["total"]["p99_us"] / 1e3
    summary[f"node_cpu_s_{kind}"] = float(open(f"{out}/{kind}.cpu").read())
summary["clients"] = json.load(open(f"{out}/clients.json"))
json.dump(summary, open(f"{out}/summary.json", "w"), indent=2, sort_keys=True)
print(json.dumps(summary, indent=2, sort_keys=True))
PY
