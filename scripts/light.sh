#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Striped shirts, tattoos, skin, little and too much light, lenses out of focus, devices that have turned: each scenario of
# config/scenarios/light from the photons to its clouds, scored against the truth. Table on the screen and in
# target/light/table.md, figures in target/light/summary.json: the worst of the seeds. Light is kept for the next run.
# Each scenario is run as it is and with three seeds of NOISE_DN; drift with ten lots of turns instead.
# Settings: ROWS ("plain tattoo ..."), NOISE_DN (0.5), SEEDS ("1 2 3"), LOTS ("1 ... 10"), OUT.
set -euo pipefail
cd "$(dirname "$0")/.."
bin=${BIN:-target/release}
out=${OUT:-target/light}
rows=${ROWS:-plain stripes_30mm stripes_13mm tattoo skin low_light over_exposed defocus drift}

. scripts/laboratory.sh

rm -rf "$out/scores"
mkdir -p "$out/scores"

# score ROW SEED LIGHT NOISE CALIBRATION
score() {
    local here=$out/now
    rm -rf "$here"
    $bin/fourdbody-sim export-png --frames "$3" --out "$here/images" --noise-dn "$4" --seed "$2"
    local code=0
    $bin/fourdbody reconstruct "$here/images" --calibration "$5" --uncertainty --out "$here/result" || code=$?
    if [ $code -eq 4 ]; then
        echo '{"refused": true}' >"$out/scores/$1.$2.json"
        return 0
    fi
    # 3: some frames are refused. They count as pixels without a point.
    [ $code -eq 0 ] || [ $code -eq 3 ] || exit $code
    $bin/fourdbody validate truth --clouds "$here/result" --truth "$3/truth" --images "$here/images" \
        --calibration "$3/calibration.json" --uncertainty --json >"$out/scores/$1.$2.json"
    rm -rf "$here"
}

for row in $rows; do
    scenario=config/scenarios/light/$row.toml
    if [ "$row" = drift ]; then
        for lot in ${LOTS:-1 2 3 4 5 6 7 8 9 10}; do
            step "$row, lot $lot"
            light=$out/light/$row-$lot
            mkdir -p "$out/scenarios"
            sed "s|^seed = .*|seed = 7$lot|; s|\"../../rig.toml\"|\"$PWD/config/rig.toml\"|" "$scenario" \
                >"$out/scenarios/$row-$lot.toml"
            $bin/fourdbody-sim render --scenario "$out/scenarios/$row-$lot.toml" --out "$light"
            score "$row" "$lot" "$light" 0 "$light/calibration-before-drift.json"
        done
        continue
    fi
    light=$out/light/$row
    $bin/fourdbody-sim render --scenario "$scenario" --out "$light"
    for seed in 0 ${SEEDS:-1 2 3}; do
        step "$row, seed $seed"
        dn=${NOISE_DN:-0.5}
        [ "$seed" != 0 ] || dn=0
        score "$row" "$seed" "$light" "$dn" "$light/calibration.json"
    done
done

step "figures, kept in $out/summary.json"
python3 scripts/summarize_light.py --scores "$out/scores" --commit "$(git rev-parse HEAD)" --table "$out/table.md" \
    --out "$out/summary.json"
