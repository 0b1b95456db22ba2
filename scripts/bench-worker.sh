#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# What reading, verifying and writing cost beside the reconstruction itself: a session of SETS frame sets (the demo's over and over)
# through `reconstruct --discard` (nothing written) and through the worker (verified, everything written), with one thread and with
# two, by turns, REPEAT times. Needs `make demo` before, and room for 40 MB a frame set. Figures go to
# target/bench-worker/summary.json. FORMS="phase ply" writes clouds, too (192 MB a frame set).
set -euo pipefail
cd "$(dirname "$0")/.."
repeat=${REPEAT:-1}
sets=${SETS:-96}
forms=${FORMS:-phase}
out=target/bench-worker
demo=target/demo
[ -f "$demo/frames/calibration.json" ] || { echo "error: no $demo; run make demo" >&2; exit 1; }
program=target/release/fourdbody
rm -rf "$out"
mkdir -p "$out"
"$program" export "$demo/sessions/demo" --to png --out "$out/frames" >/dev/null
for camera in "$out"/frames/*/; do
    camera=$(basename "$camera")
    mkdir -p "$out/images/$camera"
    own=("$out/frames/$camera"/*.png)
    for ((i = 0; i < sets; i++)); do
        ln -s "$PWD/${own[i % ${#own[@]}]}" "$out/images/$camera/$(printf %06d "$i").png"
    done
done
session=$out/session
"$program" import --rig "$demo/frames/rig.toml" --images "$out/images" --out "$session" >/dev/null
rm -rf "$out/frames" "$out/images"
for node in a b; do
    mkdir -p "$out/sessions-$node/long"
    ln -s "$PWD/$session/node-$node" "$out/sessions-$node/long/node-$node"
done
worker() { # threads format
    rm -rf "$out/results"
    cat >"$out/worker.toml" <<TOML
format = 1
results = "results"
calibration = "$PWD/$demo/frames/calibration.json"
[[node]]
name = "a"
sessions_dir = "sessions-a"
[[node]]
name = "b"
sessions_dir = "sessions-b"
[work]
threads = $1
write = "$2"
reserve_mib = 0
TOML
    "$program" worker --config "$out/worker.toml" --once 2>>"$out/worker.log"
}
for run in $(seq "$repeat"); do
    for threads in 1 2; do
        "$program" reconstruct "$session" --calibration "$demo/frames/calibration.json" --out "$out/bare" \
            --jobs "$threads" --discard --timings "$out/bare-$threads-$run.json" >/dev/null || [ $? -eq 3 ]
        for form in $forms; do
            worker "$threads" "$form"
            cp "$out/results/long/job.json" "$out/$form-$threads-$run.json"
            du -sb "$out/results/long" | cut -f1 >"$out/$form-bytes"
        done
    done
done
rm -rf "$out/results" "$out/bare" "$session"
python3 - "$out" "$repeat" $forms <<'PYTHON'
import json, os, platform, statistics, subprocess, sys
out, repeat, forms = sys.argv[1], int(sys.argv[2]), sys.argv[3:]
load = lambda name: json.load(open(f"{out}/{name}.json"))
runs = range(1, repeat + 1)
sets = load(f"{forms[0]}-1-1")["of"]
middle = lambda values: statistics.median(list(values))
summary = {"frame_sets": sets, "repeat": repeat, "seed": 7,
           "commit": subprocess.check_output(["git", "rev-parse", "HEAD"], text=True).strip(),
           "machine": f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"}
for threads in (1, 2):
    bare = middle(load(f"bare-{threads}-{run}")["wall_ms"] / 1e3 for run in runs)
    summary[f"bare_frame_sets_per_hour_per_core_{threads}_threads"] = sets / bare * 3600 / threads
    summary[f"bare_peak_memory_mib_{threads}_threads"] = max(load(f"bare-{threads}-{run}")["peak_memory_bytes"] for run in runs) / 2**20
    for form in forms:
        busy = middle(load(f"{form}-{threads}-{run}")["busy_s"] for run in runs)
        summary[f"worker_{form}_frame_sets_per_hour_per_core_{threads}_threads"] = sets / busy * 3600 / threads
        summary[f"worker_{form}_lost_percent_{threads}_threads"] = 100 * (1 - bare / busy)
        summary[f"worker_{form}_peak_memory_mib_{threads}_threads"] = max(load(f"{form}-{threads}-{run}")["peak_memory_bytes"] for run in runs) / 2**20
for form in forms:
    summary[f"worker_{form}_bytes_per_frame_set"] = int(open(f"{out}/{form}-bytes").read()) // sets
summary = {key: round(value, 2) if isinstance(value, float) else value for key, value in summary.items()}
json.dump(summary, open(f"{out}/summary.json", "w"), indent=2)
print(json.dumps(summary, indent=2))
PYTHON
