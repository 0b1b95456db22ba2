#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Faults by the hundred thousand: trains with injected faults at a high trigger rate and with tiny images, one seed
# each, until FAULTS were injected; every recording must account for every fault. Everything lies in target/accounting.
# Settings: FAULTS, RATE_HZ, TRIGGERS (of a train), SEED (the first), PLAN, OUT. Exit code 4 on any mismatch.
set -euo pipefail
cd "$(dirname "$0")/.."
bin=${BIN:-target/release}
out=${OUT:-target/accounting}
wanted=${FAULTS:-100000}
rate_hz=${RATE_HZ:-400}
triggers=${TRIGGERS:-8000}
seed=${SEED:-1}
plan=${PLAN:-config/scenarios/faults.toml}
address=${ADDRESS:-127.0.120.111}

. scripts/laboratory.sh
export FOURDBODY_LOG=${FOURDBODY_LOG:-error}

number() { grep -o "\"$1\":[0-9]*" "$2" | tail -1 | cut -d: -f2; }

rm -rf "$out"
mkdir -p "$out"
# Eight payload packets a frame: a burst must not be more than what Aravis asks for again.
sed -e 's/^width = 1920/width = 64/; s/^height = 1200/height = 64/; s/^focal_px = 2048.0/focal_px = 68.0/' \
    -e 's/exposure_us = .*/exposure_us = 300.0/' config/rig.toml >"$out/rig.toml"

# A late answer must miss the frame (given up after 40 ms at this rate), but not come 100 frames late: then Aravis
# takes its id for a new stream and throws good frames away (docs/design/faults.md).
sed -e 's/^late_ms = .*/late_ms = 100/' "$plan" >"$out/plan.toml"

total=0 wrong=0 started=$(date +%s)
while [ "$total" -lt "$wanted" ]; do
    run=$out/seed-$seed
    open_laboratory "$run/lab" --rig "$out/rig.toml" --rate-hz "$rate_hz" --buffers 128 \
        --first-port 0 --first-address "$address" --packet-bytes 576 --segment-mib 256 \
        --faults "$out/plan.toml" --fault-seed "$seed"
    record "$run/capture.json" --triggers "$triggers" --name train
    close_laboratory
    code=0
    $bin/fourdbody-sim check-accounting --pixels --truth "$run/lab/faults.jsonl" "$run/lab/sessions/train" \
        >"$run/accounting.json" 2>"$run/mismatches.log" || code=$?
    [ $code -eq 0 ] || [ $code -eq 4 ] || { cat "$run/mismatches.log" >&2; exit $code; }
    injected=$(wc -l <"$run/lab/faults.jsonl")
    bad=$(number mismatches "$run/accounting.json")
    total=$((total + injected)) wrong=$((wrong + bad))
    seconds=$(($(date +%s) - started))
    echo "seed $seed: $injected faults, $bad mismatches; in all $total faults, $wrong mismatches, $seconds s," \
        "$((total * 60 / (seconds > 0 ? seconds : 1))) faults/min"
    # What is wrong is kept; the rest would fill the disk.
    [ "$bad" -gt 0 ] || rm -rf "$run/lab/sessions"
    seed=$((seed + 1))
done
[ "$wrong" -eq 0 ] || { echo "error: $wrong mismatches; see $out/seed-*/mismatches.log" >&2; exit 4; }
