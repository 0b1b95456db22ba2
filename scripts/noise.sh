#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# How much does a result hang on a little noise? Each pose of a battery as it is, and again with noise of NOISE_DN added
# to every pixel, one run a seed. Table on the screen and in target/noise/table.md, figures in target/noise/summary.json.
# Exit code 4 where a pose's completeness moves by more than two points. Light that scripts/poses.sh has left is used again.
# Settings: BATTERY, POSES, MARKER ("zero_mean=0.3"), NOISE_DN (0.5), SEEDS ("1 2 3"), OUT.
set -euo pipefail
cd "$(dirname "$0")/.."
bin=${BIN:-target/release}
battery=${BATTERY:-poses}
out=${OUT:-target/noise}
marker=${MARKER:-zero_mean=0.3}
noise_dn=${NOISE_DN:-0.5}
all=$(cd "config/scenarios/$battery" && ls ./*.toml | sed 's|^\./||; s|\.toml$||')

. scripts/laboratory.sh

rm -rf "$out"
mkdir -p "$out/scores"
for pose in ${POSES:-$all}; do
    light=target/$battery/${marker%%=*}/$pose/light
    $bin/fourdbody-sim render --scenario "config/scenarios/$battery/$pose.toml" --marker "$marker" --out "$light"
    for seed in 0 ${SEEDS:-1 2 3}; do
        step "$battery $pose, seed $seed"
        dn=$noise_dn
        [ "$seed" != 0 ] || dn=0
        rm -rf "$out/now"
        $bin/fourdbody-sim export-png --frames "$light" --out "$out/now/images" --noise-dn "$dn" --seed "$seed"
        # 3 and 4: some or all frames are refused. They count as pixels without a point.
        $bin/fourdbody reconstruct "$out/now/images" --calibration "$light/calibration.json" --out "$out/now/result" ||
            { code=$?; [ $code -eq 3 ] || [ $code -eq 4 ]; }
        $bin/fourdbody validate truth --clouds "$out/now/result" --truth "$light/truth" --images "$out/now/images" \
            --json >"$out/scores/$battery.$pose.$seed.json"
    done
done
rm -rf "$out/now"

step "figures, kept in $out/summary.json"
python3 scripts/summarize_noise.py --scores "$out/scores" --noise-dn "$noise_dn" --commit "$(git rev-parse HEAD)" \
    --table "$out/table.md" --out "$out/summary.json"
