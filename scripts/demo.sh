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
commit=$(git rev-parse HEAD) # what was built; a commit made during the run is not

. scripts/laboratory.sh

mkdir -p "$out"
rm -rf "$out"/{lab,sessions,result,*.log}

step "light: $scenario, ray cast into eight cameras (kept in $out/frames for the next run)"
$bin/fourdbody-sim render --scenario "$scenario" --out "$out/frames"

step "laboratory: eight GigE Vision cameras on loopback, the HSU on two ptys at $rate_hz triggers a second; two nodes"
open_laboratory "$out/lab" --frames "$out/frames" --sessions-dir "$out/sessions" --rate-hz "$rate_hz"
$bin/fourdbody status --nodes "$nodes"

step "capture: $triggers triggers"
record "$out/capture.json" --triggers "$triggers" --name demo --subject P001 --note "demonstration"
$bin/fourdbody verify "$out/sessions/demo" || [ $? -eq 3 ]
close_laboratory

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
    --commit "$commit" --out "$out/summary.json"

cat <<EOT

recorded $triggers triggers at $rate_hz Hz; look at
  $out/merged.png                 the merged body of trigger $((triggers / 2)) from four sides
  $out/result/merged/*.ply        merged clouds        $out/result/clouds/*.ply   directional clouds
  $out/result/sequence.mcap       the sequence, for viewers that play foxglove.PointCloud
  $out/sessions/demo              the recordings of both nodes (MCAP)
EOT
