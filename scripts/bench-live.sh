#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# The live body beside a recording: frame sets a second, from the light to the screen, frames lost. First all eight cameras
# on two nodes at a rate that leaves a core free, then one node's four at full rate, then the same while nobody looks: what is
# lost there is not lost to the live body. Figures in
# target/bench-live/summary.json. Settings: RATE_HZ (10), DURATION (30 s), FULL_RATE_HZ (120), FULL_DURATION (10 s: 11 GB).
# Needs the demo's frames.
set -euo pipefail
cd "$(dirname "$0")/.."
bin=target/release
out=target/bench-live
rate_hz=${RATE_HZ:-10}
full_rate_hz=${FULL_RATE_HZ:-120}
duration=${DURATION:-30}
full_duration=${FULL_DURATION:-10}
. scripts/laboratory.sh
rm -rf "$out"
mkdir -p "$out"

cpu_of_nodes() {
    local sum=0 node
    for node in $(pgrep -f "fourdbody node --config $out/"); do
        sum=$(awk -v sum="$sum" '{ print sum + ($14 + $15) / 100 }' "/proc/$node/stat")
    done
    echo "$sum"
}

# measure KIND SECONDS [PORT]: a session; with PORT, with a console of that node that is looked at.
measure() {
    local kind=$1 seconds=$2 port=${3:-} before watching=
    sleep 2
    before=$(cpu_of_nodes)
    if [ -n "$port" ]; then
        python3 scripts/watch_live.py "$port" "$((seconds + 6))" >"$out/$kind-seen.json" &
        watching=$!
    fi
    record "$out/$kind.json" --duration "$seconds" --name "$kind"
    awk "BEGIN { print $(cpu_of_nodes) - $before }" >"$out/$kind.cpu"
    [ -z "$watching" ] || wait "$watching"
    close_laboratory
    rm -rf "${out:?}/sessions"
}

step "eight cameras at $rate_hz Hz, two nodes"
open_laboratory "$out/lab" --frames target/demo/frames --sessions-dir "$out/sessions" --rate-hz "$rate_hz" \
    --first-address 127.0.83.11 --first-port 7831
measure eight "$duration" 7831

for kind in full alone; do
    step "one node's four cameras at $full_rate_hz Hz: $kind"
    open_laboratory "$out/$kind-lab" --frames target/demo/frames --node a --sessions-dir "$out/sessions" \
        --rate-hz "$full_rate_hz" --first-address 127.0.83.41 --first-port 7841 --buffers 128
    port=7841
    [ $kind = full ] || port=
    measure $kind "$full_duration" $port
done

python3 - "$out" "$rate_hz" "$full_rate_hz" "$duration" "$full_duration" "$(git rev-parse HEAD)" <<'PY'
import json, os, platform, sys
out, rate, full_rate, duration, full_duration, commit = sys.argv[1], *map(float, sys.argv[2:6]), sys.argv[6]
summary = {"commit": commit, "machine": f"{platform.machine()}, {os.cpu_count()} cores", "seed": 0, "duration_s": duration, "duration_s_full_rate": full_duration,
           "trigger_rate_hz": rate, "trigger_rate_hz_full_rate": full_rate}
for kind, suffix, seconds in (("eight", "", duration), ("full", "_full_rate", full_duration), ("alone", "_full_rate_alone", full_duration)):
    nodes = [node["session"]["outcome"]["recorded"] for node in json.load(open(f"{out}/{kind}.json"))["nodes"]]
    cameras = [camera for node in nodes for camera in node["cameras"]]
    summary |= {
        f"cameras{suffix}": len(cameras),
        f"frames_recorded{suffix}": sum(camera["frames"] for camera in cameras),
        f"frames_lost{suffix}": sum(sum(camera["gaps"].values()) for camera in cameras),
        f"node_cpu_cores{suffix}": round(float(open(f"{out}/{kind}.cpu").read()) / seconds, 3),
    }
    if kind == "alone":
        continue
    seen = json.load(open(f"{out}/{kind}-seen.json"))
    summary |= {
        f"live_frame_sets_per_s{suffix}": seen["per_s"],
        f"light_to_screen_median_ms{suffix}": seen["median_ms"],
        f"light_to_screen_p99_ms{suffix}": seen["p99_ms"],
        f"live_cameras{suffix}": seen["cameras"],
        f"live_points{suffix}": seen["points"],
    }
json.dump(summary, open(f"{out}/summary.json", "w"), indent=2, sort_keys=True)
print(json.dumps(summary, indent=2, sort_keys=True))
PY
