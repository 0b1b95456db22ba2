#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Fringe orders on moving mannequins in seven poses, two instants and eight cameras each, with either marker: 224 camera
# frames, each scored against its truth. Table on the screen and in target/poses/table.md, figures in
# target/poses/summary.json; light is kept for the next run, clouds are not.
# BATTERY=held_out_again takes seven others instead (target/held_out_again), which nothing is chosen with: what the figures
# are worth elsewhere. BATTERY=held_out takes others, which an earlier solver was chosen with. BATTERY=bodies takes other motions and heights.
# Settings: BATTERY, POSES ("arms_crossed walking ..."), MARKERS ("zero_mean=0.3 darkened=0.8"), METHOD (joint or
# paper), OUT, KEEP=1 (keeps the clouds and draws where they are right, wrong or missing).
set -euo pipefail
cd "$(dirname "$0")/.."
bin=${BIN:-target/release}
battery=${BATTERY:-poses}
out=${OUT:-target/$battery}
method=${METHOD:-joint}
markers=${MARKERS:-"zero_mean=0.3 darkened=0.8"}
all=$(cd "config/scenarios/$battery" && ls ./*.toml | sed 's|^\./||; s|\.toml$||')
poses=${POSES:-$all}

. scripts/laboratory.sh

rm -rf "$out/scores"
mkdir -p "$out/scores"
for marker in $markers; do
    kind=${marker%%=*}
    for pose in $poses; do
        step "$pose, marker $marker"
        here=$out/$kind/$pose
        $bin/fourdbody-sim render --scenario "config/scenarios/$battery/$pose.toml" --marker "$marker" --out "$here/light"
        rm -rf "$here"/{images,clouds,pictures}
        $bin/fourdbody-sim export-png --frames "$here/light" --out "$here/images"
        # 3 and 4: some or all frames are refused. That is no failure here: they count as pixels without a point.
        $bin/fourdbody reconstruct "$here/images" --calibration "$here/light/calibration.json" --out "$here/clouds" \
            --method "$method" || { code=$?; [ $code -eq 3 ] || [ $code -eq 4 ]; }
        score=(--clouds "$here/clouds" --truth "$here/light/truth" --images "$here/images")
        [ -z "${KEEP:-}" ] || score+=(--pictures "$here/pictures")
        $bin/fourdbody validate truth "${score[@]}" --json >"$out/scores/$kind.$pose.json"
        [ -n "${KEEP:-}" ] || rm -rf "$here"/{images,clouds}
    done
done

step "figures, kept in $out/summary.json"
python3 scripts/summarize_poses.py --scores "$out/scores" --scenarios "config/scenarios/$battery" --method "$method" \
    --commit "$(git rev-parse HEAD)" --table "$out/table.md" --out "$out/summary.json"
