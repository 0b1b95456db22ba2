#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Photographs that others took, each alone through our way to a phase and a cloud, against what others make of many:
# a hand and a statue before two cameras (github.com/GeyouZhang/BSC), four objects before one (github.com/yongleex/CFPE).
# They are read where they are, or cloned to ~/.cache/fourdbody/photographs, and are never part of the project; a set that
# is not there is named. Tables on the screen and in target/real/table.md, figures in target/real/summary.json.
# Settings: PHOTOGRAPHS (a directory with clones BSC and CFPE), DATA (../shared/data, for masks), STEP (3), OUT.
set -euo pipefail
cd "$(dirname "$0")/.."
bin=${BIN:-target/release}
out=${OUT:-target/real}
sets=${PHOTOGRAPHS:-${FOURDBODY_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/fourdbody}/photographs}
data=${DATA:-../shared/data}

. scripts/laboratory.sh

# present NAME URL COMMIT FOLDER: whether the set is there, cloned if need be.
present() {
    [ ! -d "$sets/$1" ] || return 0
    mkdir -p "$sets"
    if git clone --quiet --filter=blob:none --no-checkout "$2" "$sets/$1.part" 2>"$out/clone.log" &&
        git -C "$sets/$1.part" checkout --quiet "$3" -- "$4" 2>>"$out/clone.log"; then
        mv "$sets/$1.part" "$sets/$1"
        return 0
    fi
    rm -rf "$sets/$1.part"
    echo "skipped: expected a clone of $2 in $sets/$1, and it could not be fetched; see $out/clone.log"
    return 1
}

rm -rf "$out"
mkdir -p "$out"
scripts/make-venv.sh target/peers/venv numpy==2.4.3 scipy==1.17.1 scikit-image==0.26.0 \
    opencv-contrib-python-headless==5.0.0.93
python=target/peers/venv/bin/python
$python -c 'import cv2, scipy, skimage' || { echo "error: the packages of target/peers/venv could not be installed" >&2; exit 1; }

places=()
[ ! -d "$data/real" ] || places+=("$data/real")
if present CFPE https://github.com/yongleex/CFPE b01375b0 data/recordings; then
    places+=("$sets/CFPE")
fi
if [ ${#places[@]} -gt 0 ]; then
    step "wrapped phase of one photograph against that of twelve: ${places[*]}"
    PYTHONPATH=benches/peers $python benches/photographs/cfpe.py --data "${places[@]}" --ours $bin/examples/wrapped_phase \
        --out "$out/cfpe.json"
fi
if present BSC https://github.com/GeyouZhang/BSC 7b0b25b Data; then
    step "clouds of single photographs against nine: $sets/BSC"
    $python benches/photographs/bsc.py --data "$sets/BSC" --fourdbody $bin/fourdbody --work "$out/bsc" \
        --out "$out/bsc.json" --step "${STEP:-3}"
fi
step "figures, kept in $out/summary.json"
python3 scripts/summarize_real.py --out "$out" --commit "$(git rev-parse HEAD)"
