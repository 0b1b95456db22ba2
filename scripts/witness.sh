#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# The light as a witness of the trigger (docs/design/reconstruction.md): mannequins that move at 120 Hz before eight
# cameras, as they are and with frames that are exchanged for those of other triggers. Table on the screen and in
# target/witness/table.md; light is kept for the next run. Settings: SCENES, OUT, BIN.
set -euo pipefail
cd "$(dirname "$0")/.."
bin=${BIN:-target/release}
out=${OUT:-target/witness}
# Name, motion, period s, seed, instants, where in its period it starts.
scenes=${SCENES:-"walk_a:walk_in_place:1.0:7:10:0.05 walk_b:walk_in_place:1.3:31:10:0.45 walk_p2:walk_in_place:2:52:6:0.1
    walk_p4:walk_in_place:4:54:6:0.1 walk_p8:walk_in_place:8:58:6:0.1 walk_p16:walk_in_place:16:66:6:0.1 arms_b:arm_raise:2:32:10:0.3
    stand_b:stand:4:33:8:0.1 twist_b:twist:2.5:34:10:0 bend_b:bend:3:35:10:0.2 cross_b:arms_crossed:1.0:36:6:0.45"}

# The exchanges: CAMERA:FROM-TO:BY, where the frame of trigger t is that of trigger t + BY.
declare -A exchanges=(
    [none]=""
    [one]="h0_up:2-2:-1 h2_low:4-4:1"
    [two]="h0_up:3-3:-2 h2_low:6-6:2"
    [five]="h0_up:6-6:-5"
    [run]="h1_up:2-7:-1"
    [good]="h3_low:0-9:-1"
)

mkdir -p "$out"
echo "| scene | motion, period s | exchanged | refused as of another trigger | refused otherwise | suspects |" >"$out/table.md"
echo "|---|---|---|---|---|---|" >>"$out/table.md"
for scene in $scenes; do
    IFS=: read -r scene kind period seed instants start <<<"$scene"
    here=$out/$scene
    mkdir -p "$here"
    cat >"$here/scenario.toml" <<EOT
format = 1
name = "$scene"
seed = $seed
rig = "$PWD/config/rig.toml"
instants = $instants
after_end = "ping_pong"
light = ["fringes"]
truth_every = 0

[optics]
exposure_dn = 240.0

[subject]
kind = "mannequin"
motion = "$kind"
period_s = $period
start = $start
EOT
    "$bin/fourdbody-sim" render --scenario "$here/scenario.toml" --out "$here/light" >&2
    "$bin/fourdbody-sim" export-png --frames "$here/light" --out "$here/images" >&2
    case $scene in
    walk_a) names="none one two five run good" ;;
    walk_*) names="none one" ;;
    *) names=none ;;
    esac
    for name in $names; do
        rm -rf "$here/shown" "$here/result"
        for camera in "$here"/images/*; do
            mkdir -p "$here/shown/${camera##*/}"
            ln -s "$PWD/$camera"/*.png "$here/shown/${camera##*/}/"
        done
        for one in ${exchanges[$name]}; do
            IFS=:- read -r camera from to by <<<"${one/:-/:m}"
            by=${by/m/-}
            for ((t = from; t <= to; t++)); do
                other=$((t + by < 0 ? 0 : t + by >= instants ? instants - 1 : t + by))
                ln -sfn "$PWD/$here/images/$camera/$(printf %06d "$other").png" "$here/shown/$camera/$(printf %06d "$t").png"
            done
        done
        "$bin/fourdbody" reconstruct "$here/shown" --calibration "$here/light/calibration.json" --out "$here/result" >/dev/null ||
            [ $? -eq 3 ]
        python3 - "$here/result/summary.json" "$scene" "$kind, $period" "$instants" "$name" "${exchanges[$name]}" <<'EOT' | tee -a "$out/table.md"
import json, sys
path, scene, motion, instants, name, exchanged = sys.argv[1:]
summary = json.load(open(path))
wrong = set()
for one in exchanged.split():
    camera, rest = one.split(":", 1)
    (first, last), by = rest.split(":")[0].split("-"), int(rest.split(":")[1])
    triggers = range(int(first), int(last) + 1)
    wrong |= {(camera, t) for t in triggers if min(max(t + by, 0), int(instants) - 1) != t}
frames = [(f["camera"], t["trigger"], f.get("reason") or "") for t in summary["triggers"] for f in t["frames"]]
shown = {(c, t) for c, t, why in frames if why.startswith("it shows trigger")}
other = sum(bool(why) and not why.startswith("it shows trigger") for _, _, why in frames)
found = f"{len(shown & wrong)} of {len(wrong)}" + (f", and {len(shown - wrong)} wrongly" if shown - wrong else "")
print(f"| {scene} | {motion} | {name} | {found} | {other} | {len(summary.get('suspects', []))} |")
EOT
    done
done
