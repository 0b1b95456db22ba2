#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# How long reconstruction takes, and how good it is: recorded frames (rendered light, imported into MCAP sessions; no cameras),
# from mapping a frame to points with normals in memory. Figures in target/bench-reconstruct/summary.json.
# Settings: SCENES, INSTANTS (120, one second, of the first scene; 2 of the others), REPEAT (3), PEERS=0 (without the other programs), POSES=1 (also scripts/poses.sh), OUT.
set -euo pipefail
cd "$(dirname "$0")/.."
bin=${BIN:-target/release}
out=${OUT:-target/bench-reconstruct}
scenes=${SCENES:-"demo arms_crossed turntable plane sphere torso"}
repeat=${REPEAT:-3}
commit=$(git rev-parse HEAD) # what was built; a commit made during the run is not

. scripts/laboratory.sh

# scene_file SCENE
scene_file() {
    if [ -f "config/scenarios/poses/$1.toml" ]; then echo "config/scenarios/poses/$1.toml"; else echo "config/scenarios/$1.toml"; fi
}

# timed NAME SCENE OPTIONS...: one run that keeps no cloud; its stages and the process's own time go to runs/NAME.json.
timed() {
    local name=$1 scene=$2 began ended cpu
    shift 2
    began=$(date +%s%N)
    TIMEFORMAT='%U %S'
    cpu=$({ time $bin/fourdbody reconstruct "$out/$scene/session" --calibration "$out/$scene/light/calibration.json" \
        --out "$out/$scene/discarded" --discard --timings "$out/runs/timings.json" "$@" >/dev/null || [ $? -eq 3 ]; } 2>&1)
    ended=$(date +%s%N)
    printf '{"wall_s": %s, "cpu_s": [%s], "timings": %s}\n' "$(awk "BEGIN { print ($ended - $began) / 1e9 }")" \
        "${cpu/ /, }" "$(cat "$out/runs/timings.json")" >"$out/runs/$name.json"
}

# scored NAME SCENE OPTIONS...: the clouds of those instants that have a truth, how good they are in scores/NAME.json.
scored() {
    local name=$1 here=$out/$2 trigger
    shift 2
    rm -rf "$here/clouds"
    for trigger in $(ls "$here"/light/truth/*.npz | sed -E 's/.*_0*([0-9]+)\.npz$/\1/' | sort -nu); do
        $bin/fourdbody reconstruct "$here/session" --calibration "$here/light/calibration.json" --out "$here/clouds" \
            --triggers "$trigger..$((trigger + 1))" "$@" >/dev/null || [ $? -eq 3 ]
    done
    $bin/fourdbody validate truth --clouds "$here/clouds" --truth "$here/light/truth" --images "$here/session" --json >"$out/scores/$name.json"
    rm -rf "$here/clouds"
}

mkdir -p "$out"
rm -rf "$out/runs" "$out/scores"
mkdir -p "$out/runs" "$out/scores"
for scene in $scenes; do
    # The first scene tells the time: of one second of capture.
    instants=2
    [ "$scene" != "${scenes%% *}" ] || instants=${INSTANTS:-120}
    step "light: $(scene_file "$scene"), $instants instants, imported as a session"
    here=$out/$scene
    $bin/fourdbody-sim render --scenario "$(scene_file "$scene")" --instants "$instants" --out "$here/light"
    rm -rf "$here"/{images,session}
    $bin/fourdbody-sim export-png --frames "$here/light" --out "$here/images"
    $bin/fourdbody import --rig "$here/light/rig.toml" --images "$here/images" --out "$here/session"
    $bin/fourdbody reconstruct "$here/session" --calibration "$here/light/calibration.json" --out "$here/discarded" \
        --discard --json >"$out/runs/$scene.summary" || [ $? -eq 3 ]
    # Only some scenes have a truth.
    ls "$here"/light/truth/*.npz >/dev/null 2>&1 || continue
    scored "$scene" "$scene"
done

# Turn by turn, so that what else the machine does is spread over all.
for run in $(seq "$repeat"); do
    step "repetition $run of $repeat"
    for scene in $scenes; do
        timed "one.$scene.$run" "$scene" --jobs 1
    done
    first=${scenes%% *}
    timed "two.$first.$run" "$first" --jobs 2
    timed "first_1_thread.$first.$run" "$first" --jobs 1 --triggers 0..1
    timed "first_2_threads.$first.$run" "$first" --jobs 2 --triggers 0..1
    for path in portable avx2 avx512; do
        FOURDBODY_SIMD=$path timed "$path.$first.$run" "$first" --jobs 1
    done
done

if [ "${PEERS:-1}" != 0 ]; then
    step "other programs on the same frames: scikit-image, OpenCV contrib, Fourier methods (one thread each)"
    scripts/make-venv.sh target/peers/venv numpy==2.4.3 scipy==1.17.1 scikit-image==0.26.0 \
        opencv-contrib-python-headless==5.0.0.93
    example=$bin/examples/wrapped_phase
    targets=()
    for scene in $scenes; do
        case $scene in demo | arms_crossed) targets+=(--scene "$out/$scene:h0_low:0") ;; esac
    done
    python=target/peers/venv/bin/python
    if ! $python -c 'import cv2, scipy, skimage' 2>/dev/null; then
        echo "skipped: the other programs could not be installed"
    else
        $python benches/peers/compare.py "${targets[@]}" --ours "$example" --out "$out/peers.json"
    fi
fi
if [ "${POSES:-0}" = 1 ]; then
    # An own meaning of POSES there.
    (unset POSES && scripts/poses.sh)
fi

step "figures, kept in $out/summary.json"
python3 scripts/summarize_reconstruct.py --runs "$out/runs" --scores "$out/scores" --body "${scenes%% *}" \
    --commit "$commit" --peers "$out/peers.json" --out "$out/summary.json"
