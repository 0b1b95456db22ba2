#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Fringe orders in other geometries: distance, volume, period, heads, cameras a head, which way the cameras lie.

Each row is a rig of its own and one instant of a walking mannequin in it, scored against its truth. Table on the screen,
figures in target/geometry/summary.json.
Settings: BIN (target/release), OUT (target/geometry), ROWS (names as in the table, separated by "; ").
"""

import json
import math
import os
import pathlib
import shutil
import subprocess

BIN = os.environ.get("BIN", "target/release")
OUT = pathlib.Path(os.environ.get("OUT", "target/geometry"))

# What differs from four heads of two cameras 2.4 m from a volume of 1.5 x 1.5 x 2 m, period 8 px, cameras above and below.
ROWS = {
    "as shipped": {},
    "distance 4 m": {"distance": 4.0, "volume": [2.0, 2.0, 2.0]},
    "distance 1.5 m, volume 1 m": {"distance": 1.5, "volume": [1.0, 1.0, 1.0], "middle": 1.25},
    "face, 0.8 m, volume 0.3 m": {"distance": 0.8, "volume": [0.3, 0.3, 0.3], "middle": 1.55},
    "face, 0.8 m, volume 0.6 m": {"distance": 0.8, "volume": [0.6, 0.6, 0.6], "middle": 1.55},
    "face, 0.8 m, volume 0.9 m": {"distance": 0.8, "volume": [0.9, 0.9, 0.9], "middle": 1.55},
    "face, 0.8 m, volume 0.9 m, period 4 px": {
        "distance": 0.8, "volume": [0.9, 0.9, 0.9], "middle": 1.55, "period": 4.0},
    "face, 0.5 m, volume 0.4 m": {"distance": 0.5, "volume": [0.4, 0.4, 0.4], "middle": 1.55},
    "distance 4 m, volume 3 m": {"distance": 4.0, "volume": [3.0, 3.0, 2.2]},
    "period 4 px": {"period": 4.0},
    "period 5 px": {"period": 5.0},
    "period 12 px": {"period": 12.0},
    "period 16 px": {"period": 16.0},
    "one head of two": {"heads": 1},
    "two heads of two": {"heads": 2},
    "three heads of two": {"heads": 3},
    "four heads of three": {"cameras": 3},
    "four heads of four": {"cameras": 4},
    "four heads of one": {"cameras": 1},
    "left and right": {"across": True},
    "left and right, three": {"across": True, "cameras": 3},
    "lens of half the focal length": {"focal": 0.5},
}

# Where the cameras of a head lie beside its projector, in thirds of the distance.
SIDES = [1.0, -1.0, 0.5, -0.6]


def rig(distance=2.4, volume=(1.5, 1.5, 2.0), middle=1.0, period=8.0, heads=4, cameras=2, across=False, focal=1.0):
    """The text of a rig file; `middle` is the height of the volume's middle, lengths in m."""
    low = max(middle - volume[2] / 2, 0.0)
    corners = ([-volume[0] / 2, -volume[1] / 2, low], [volume[0] / 2, volume[1] / 2, low + volume[2]])
    text = [
        'format = 1', 'name = "geometry"', 'trigger_rate_hz = 120.0', '[volume]',
        f'min_m = {corners[0]}', f'max_m = {corners[1]}',
        '[pattern]', f'period_px = {period}', f'marker_index = {round(640 / period)}', 'marker = "zero_mean"',
        'marker_strength = 0.3', 'marker_period_px = 8.0', 'low = 0.0', 'high = 1.0', 'gamma = 1.0',
        '[board]', 'width_m = 1.5', 'height_m = 2.0', 'pitch_m = 0.1', 'columns = 14', 'rows = 19', 'radius_m = 0.015',
        'large_radius_m = 0.024', 'large = [[4, 13], [5, 13], [4, 16], [7, 13], [10, 4]]',
    ]
    for h in range(heads):
        angle = 2 * math.pi * h / max(heads, 2)
        out = (math.cos(angle), math.sin(angle))
        roll = 0.0 if across else 90.0

        def device(side):
            aside = side * distance / 3
            if across:
                place = [distance * out[0] - aside * out[1], distance * out[1] + aside * out[0], middle + 0.05]
            else:
                place = [distance * out[0], distance * out[1], middle + 0.05 + aside]
            place = [round(x, 6) + 0.0 for x in place]
            return [f'position_m = {place}', f'look_at_m = [0.0, 0.0, {middle}]', f'roll_deg = {roll}']

        text += ['[[head]]', f'id = "h{h}"', f'channel = "{"RGB"[h % 3] if heads != 4 else "RGRG"[h]}"', 'delay_us = 200.0',
                 'exposure_us = 1000.0', '[head.projector]', 'width = 1280', 'height = 800',
                 f'focal_px = {1400.0 * focal}', *device(0.0)]
        for c in range(cameras):
            text += ['[[head.camera]]', f'id = "h{h}_{c}"', f'node = "{"ab"[h * 2 // max(heads, 2)]}"', 'width = 1920',
                     'height = 1200', f'focal_px = {2048.0 * focal}', *device(SIDES[c])]
    return "\n".join(text) + "\n"


def scenario(here, distance=2.4, **_):
    return f"""format = 1
name = "geometry"
seed = 7
rig = "{here.resolve()}/rig.toml"
instants = 1
after_end = "wrap"
truth_every = 1
[optics]
exposure_dn = 240.0
exposure_distance_m = {distance}
[subject]
kind = "mannequin"
motion = "walk_in_place"
period_s = 1.5
start = 0.2
heading_deg = 20.0
"""


def run(*arguments, allowed=(0,)):
    done = subprocess.run([str(x) for x in arguments], capture_output=True, text=True)
    if done.returncode not in allowed:
        raise SystemExit(f"{' '.join(map(str, arguments))}: exit {done.returncode}: {done.stdout}{done.stderr}")
    return done


def measure(name, what):
    here = OUT / "".join(c if c.isalnum() else "_" for c in name)
    here.mkdir(parents=True, exist_ok=True)
    (here / "rig.toml").write_text(rig(**what))
    (here / "scenario.toml").write_text(scenario(here, **what))
    run(f"{BIN}/fourdbody-sim", "render", "--scenario", here / "scenario.toml", "--out", here / "light")
    run(f"{BIN}/fourdbody-sim", "export-png", "--frames", here / "light", "--out", here / "images")
    calibration = here / "light/calibration.json"
    shutil.rmtree(here / "result", ignore_errors=True)
    done = run(f"{BIN}/fourdbody", "reconstruct", here / "images", "--calibration", calibration, "--out", here / "result",
               allowed=(0, 1, 2, 3, 4))
    score = run(f"{BIN}/fourdbody", "validate", "truth", "--clouds", here / "result", "--truth", here / "light/truth",
                "--images", here / "images", "--json", allowed=(0, 1, 2, 3, 4, 5))
    row = {"exit": done.returncode}
    try:
        all_cameras = json.loads(score.stdout)["directional"]
        usable = next(x for x in all_cameras["by_modulation"] if x["min_modulation_dn"] == 6.0)
        row |= {
            "points": all_cameras["points"],
            "wrong_percent": 100 * all_cameras["wrong_order_share"],
            "complete_percent": 100 * usable["whole_completeness"],
            "robust_mm": all_cameras["robust_mm"],
        }
    except (ValueError, KeyError, TypeError):
        row["message"] = (done.stderr.strip() or score.stderr.strip()).splitlines()[-1:]
    return row


def main():
    chosen = os.environ.get("ROWS")
    rows = {}
    OUT.mkdir(parents=True, exist_ok=True)
    print("| geometry | exit | points | wrong % | of usable, whole fringe % | robust mm |\n|---|---|---|---|---|---|")
    for name, what in ROWS.items():
        if chosen and name not in chosen.split("; "):
            continue
        row = rows[name] = measure(name, what)
        cells = [f"{row[k]:.3f}" if k in row and row[k] is not None else "" for k in ("wrong_percent", "complete_percent", "robust_mm")]
        print(f"| {name} | {row['exit']} | {row.get('points', 0)} | {' | '.join(cells)} | {row.get('message', '')}", flush=True)
    commit = run("git", "rev-parse", "HEAD").stdout.strip()
    (OUT / "summary.json").write_text(json.dumps({"commit": commit, "rows": rows}, indent=1) + "\n")


main()
