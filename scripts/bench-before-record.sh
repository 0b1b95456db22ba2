#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Seconds before Record at full rate: four cameras on one node, held until the oldest give way, then recorded and verified.
# Figures of the worst run in target/bench-before-record/summary.json. Settings: RATE_HZ (120), BEFORE (5 s), DURATION (5 s),
# RUNS (3). Needs 1.1 GB of memory and of disk for each second.
set -euo pipefail
cd "$(dirname "$0")/.."
bin=target/release
out=target/bench-before-record
rate_hz=${RATE_HZ:-120}
before=${BEFORE:-5}
duration=${DURATION:-5}
. scripts/laboratory.sh
rm -rf "$out"
mkdir -p "$out"

session() { curl -sf "${nodes%%,*}/api/v1/status"; }
memory_mib() { awk '/VmRSS/ { printf "%d\n", $2 / 1024 }' "/proc/$(pgrep -f "fourdbody node --config $out/")/status"; }
# The oldest give way: two seconds more have gone by than are held.
is_full() { session | python3 -c "import json, sys; sys.exit(json.load(sys.stdin)['session']['held']['end'] < ($before + 3) * $rate_hz)"; }

for run in $(seq "${RUNS:-3}"); do
    step "run $run"
    open_laboratory "$out/lab" --rig config/rig.toml --node a --first-port 0 --first-address 127.0.9.11 --buffers 128 \
        --rate-hz "$rate_hz" --sessions-dir "$out/sessions"
    sleep 2
    mkfifo "$out/enter"
    record "$out/$run.json" --pre-trigger "$before" --duration "$duration" --name "run-$run" <"$out/enter" &
    capture=$!
    exec 3>"$out/enter"
    wait_for 120 is_full
    session >"$out/$run-held.json"
    memory_mib >"$out/$run-held.mib"
    echo >&3
    wait "$capture"
    exec 3>&-
    sleep 1
    memory_mib >"$out/$run-after.mib"
    close_laboratory
    code=0
    $bin/fourdbody verify "$out/sessions/run-$run" >"$out/$run.verify" || code=$?
    # 3: frames are missing, and each has a gap record.
    [ $code -eq 0 ] || [ $code -eq 3 ] || exit $code
    rm -rf "$out/sessions" "$out/enter"
done

python3 - "$out" "$rate_hz" "$before" "$(git rev-parse HEAD)" <<'PY'
import glob, json, os, platform, sys
out, rate_hz, before_s, commit = sys.argv[1], float(sys.argv[2]), float(sys.argv[3]), sys.argv[4]
runs = []
for name in sorted(glob.glob(f"{out}/[0-9].json")):
    at = name.removesuffix(".json")
    held = json.load(open(f"{at}-held.json"))["session"]["held"]
    session = json.load(open(name))["nodes"][0]["session"]
    mib = lambda when: int(open(f"{at}-{when}.mib").read())
    runs.append({"held_frame_sets": held["end"] - held["oldest"], "held_mib": mib("held"), "after_mib": mib("after"),
                 "triggers": session["triggers"], "frames_lost": sum(camera["gaps"] for camera in session["cameras"])})
worst = {key: max(run[key] for run in runs) for key in runs[0] if key != "triggers"}
summary = {"commit": commit, "machine": f"{platform.machine()}, {os.cpu_count()} cores", "seed": 7, "runs": len(runs),
           "trigger_rate_hz": rate_hz, "before_s": before_s, "triggers": min(run["triggers"] for run in runs),
           "frames_lost_of_each": [run["frames_lost"] for run in runs], **worst}
json.dump(summary, open(f"{out}/summary.json", "w"), indent=2, sort_keys=True)
print(json.dumps(summary, indent=2, sort_keys=True))
PY
