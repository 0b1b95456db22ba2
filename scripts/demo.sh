#!/bin/bash
# The whole chain, from simulated light to a merged point cloud, in real processes and over real protocols.
# Everything it makes lies in target/demo. Settings: TRIGGERS, RATE_HZ.
set -euo pipefail
cd "$(dirname "$0")/.."
bin=target/release
out=target/demo
triggers=${TRIGGERS:-24}
rate_hz=${RATE_HZ:-20}
scenario=config/scenarios/demo.toml

step() { printf '\n== %s\n' "$*"; }
children=()
cleanup() {
    [ ${#children[@]} -eq 0 ] || kill "${children[@]}" 2>/dev/null || true
    wait 2>/dev/null || true
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

mkdir -p "$out"
rm -rf "$out"/{lab,sessions,result,*.log}

step "light: $scenario, ray cast into eight cameras (kept in $out/frames for the next run)"
$bin/fourdbody-sim render --scenario "$scenario" --out "$out/frames"

step "laboratory: eight GigE Vision cameras on loopback, the HSU on two ptys, at $rate_hz triggers a second"
$bin/fourdbody-sim run --frames "$out/frames" --run-dir "$out/lab" --sessions-dir "$out/sessions" \
    --rate-hz "$rate_hz" >"$out/lab.json" 2>"$out/lab.log" &
children+=($!)
wait_for 30 grep -q '"ready":true' "$out/lab.json"
nodes=http://127.0.0.1:7401,http://127.0.0.1:7402

step "nodes: two fourdbody processes"
for node in a b; do
    $bin/fourdbody node --config "$out/lab/node-$node.toml" 2>"$out/node-$node.log" &
    children+=($!)
done
wait_for 30 $bin/fourdbody status --nodes "$nodes"
$bin/fourdbody status --nodes "$nodes"

step "capture: $triggers triggers"
$bin/fourdbody capture --nodes "$nodes" --triggers "$triggers" --name demo --subject P001 \
    --note "demonstration" --json >"$out/capture.json" || {
    code=$?
    # 3: frames are missing, each with a gap record; the chain goes on and the figures say so.
    [ $code -eq 3 ] || { echo "error: capture failed with exit code $code; see $out/node-*.log" >&2; exit $code; }
}
$bin/fourdbody verify "$out/sessions/demo" || [ $? -eq 3 ]
cleanup
children=()

step "reconstruction: 8 x $triggers frames, one cloud each, merged by trigger"
$bin/fourdbody reconstruct "$out/sessions/demo" --calibration "$out/frames/calibration.json" --out "$out/result" \
    --timings "$out/timings.json" || [ $? -eq 3 ]

step "score: every cloud whose truth was kept, against the true surface"
score=(--clouds "$out/result" --truth "$out/frames/truth" --calibration "$out/frames/calibration.json")
$bin/fourdbody validate truth "${score[@]}"
$bin/fourdbody validate truth "${score[@]}" --json >"$out/score.json"
middle=$(printf '%06d' $((triggers / 2)))
$bin/fourdbody view "$out/result/merged/$middle.ply" --out "$out/merged.png" --sides 4

step "figures (points are per merged cloud), kept in $out/summary.json"
$bin/fourdbody-sim summarize --scenario "$scenario" --rate-hz "$rate_hz" --capture "$out/capture.json" \
    --reconstruction "$out/result/summary.json" --score "$out/score.json" \
    --commit "$(git rev-parse HEAD)" --out "$out/summary.json"

cat <<EOT

recorded $triggers triggers at $rate_hz Hz; look at
  $out/merged.png                 the merged body of trigger $((triggers / 2)) from four sides
  $out/result/merged/*.ply        merged clouds        $out/result/clouds/*.ply   directional clouds
  $out/result/sequence.mcap       the sequence, for viewers that play foxglove.PointCloud
  $out/sessions/demo              the recordings of both nodes (MCAP)
EOT
