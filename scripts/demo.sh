#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
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
rm -rf "$out"/{lab,sessions,result,clouds,*.log}

step "light: $scenario, ray cast into eight cameras (kept in $out/frames for the next run)"
$bin/fourdbody-sim render --scenario "$scenario" --out "$out/frames"

step "laboratory: eight GigE Vision cameras on loopback, the HSU on two ptys at $rate_hz triggers a second; two nodes"
open_laboratory "$out/lab" --frames "$out/frames" --sessions-dir "$out/sessions" --rate-hz "$rate_hz"
$bin/fourdbody status --nodes "$nodes"

step "capture: $triggers triggers"
record "$out/capture.json" --triggers "$triggers" --name demo --subject P001 --note "demonstration"
$bin/fourdbody verify "$out/sessions/demo" || [ $? -eq 3 ]
close_laboratory

step "reconstruction: 8 x $triggers frames, a phase map each"
$bin/fourdbody reconstruct "$out/sessions/demo" --calibration "$out/frames/calibration.json" --out "$out/result" \
    --timings "$out/timings.json" || [ $? -eq 3 ]

step "score: every cloud whose truth was kept, against the true surface"
score=(--clouds "$out/result" --truth "$out/frames/truth")
$bin/fourdbody validate truth "${score[@]}"
$bin/fourdbody validate truth "${score[@]}" --json >"$out/score.json"
middle=$((triggers / 2))
$bin/fourdbody view "$out/result" --trigger "$middle" --out "$out/merged.png" --sides 4

step "export: what is shown, as files of other programs: the sequence, and the clouds of trigger $middle"
$bin/fourdbody export "$out/result" --to mcap --out "$out/clouds" --json >"$out/export.json"
$bin/fourdbody export "$out/result" --to ply --clouds merged,directional --triggers "$middle..$((middle + 1))" --out "$out/clouds"

step "report: a page that plays the body, for any browser"
$bin/fourdbody report "$out/sessions/demo" --clouds "$out/result" --play --out "$out/report.html"

step "figures (points are per merged cloud), kept in $out/summary.json"
$bin/fourdbody-sim summarize --scenario "$scenario" --rate-hz "$rate_hz" --capture "$out/capture.json" \
    --export "$out/export.json" --score "$out/score.json" \
    --commit "$commit" --out "$out/summary.json"

cat <<EOT

recorded $triggers triggers at $rate_hz Hz; look at
  $out/report.html                in a browser: the body moves, and can be turned; verdict and light of the session
  $out/merged.png                 the merged body of trigger $middle from four sides
  $out/clouds/sequence.mcap       the merged clouds of all triggers, for viewers that play foxglove.PointCloud
  $out/clouds/merged/*.ply        the merged cloud of trigger $middle      $out/clouds/clouds/*.ply   those of its cameras
  $out/result                     the phase maps, of which \`fourdbody view\` and \`export\` make all clouds
  $out/sessions/demo              the recordings of both nodes (MCAP)
EOT
