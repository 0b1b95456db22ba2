#!/bin/bash
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

children=()
cleanup() {
    [ ${#children[@]} -eq 0 ] || kill "${children[@]}" 2>/dev/null || true
    wait 2>/dev/null || true
    children=()
}
trap cleanup EXIT

# wait_for SECONDS COMMAND...: until the command succeeds.
wait_for() {
    local tries=$(($1 * 10))
    shift
    until "$@" >/dev/null 2>&1; do
        tries=$((tries - 1))
        [ $tries -gt 0 ] || { echo "error: waited in vain for: $*; see the logs in $out" >&2; exit 1; }
        sleep 0.1
    done
}

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
    mkdir -p "$run"
    $bin/fourdbody-sim run --rig "$out/rig.toml" --run-dir "$run/lab" --rate-hz "$rate_hz" --buffers 128 \
        --first-port 0 --first-address "$address" --packet-bytes 576 --segment-mib 256 \
        --faults "$out/plan.toml" --fault-seed "$seed" >"$run/lab.json" 2>"$run/lab.log" &
    children+=($!)
    wait_for 30 grep -q '"ready":true' "$run/lab.json"
    urls=$(grep -o '"urls":"[^"]*"' "$run/lab.json" | cut -d'"' -f4)
    for config in "$run"/lab/node-*.toml; do
        FOURDBODY_LOG=error $bin/fourdbody node --config "$config" 2>"$run/$(basename "$config" .toml).log" &
        children+=($!)
    done
    # Devices take a moment to answer; a capture before that is refused and leaves nothing.
    wait_for 30 $bin/fourdbody status --nodes "$urls"
    code=0
    $bin/fourdbody capture --nodes "$urls" --triggers "$triggers" --name train --json \
        >"$run/capture.json" 2>"$run/capture.log" || code=$?
    [ $code -eq 0 ] || [ $code -eq 3 ] || { cat "$run/capture.log" >&2; exit $code; }
    cleanup
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
