#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Calibrations from which one device, one head or all devices have moved: what `calibration check` says of each.

A calibration is changed, not the light. For each change and each scene: does the check notice it (a move in its best
explanation), does it name the device and the kind, and what is the robust error of the clouds before the correction and
after it. Then frame sets with noise and the true calibration: how many alarms are false. Figures in target/drift/summary.json.
Settings: BIN (target/release), OUT (target/drift), SCENES (scenario files), ROWS (parts of names, separated by ";"),
ALARMS (100 frame sets).
"""

import hashlib
import json
import math
import os
import pathlib
import random
import re
import shutil
import subprocess
from decimal import Decimal

BIN = os.environ.get("BIN", "target/release")
OUT = pathlib.Path(os.environ.get("OUT", "target/drift"))
SCENES = "config/scenarios/light/plain.toml config/scenarios/bodies/tall_bend.toml"


def rotated(matrix, turn):
    """A rotation of a device, turned about the device's own axes by `turn`, rad."""
    angle = math.sqrt(sum(x * x for x in turn))
    if angle == 0.0:
        return matrix
    x, y, z = (t / angle for t in turn)
    c, s = math.cos(angle), math.sin(angle)
    about = [
        [c + x * x * (1 - c), x * y * (1 - c) - z * s, x * z * (1 - c) + y * s],
        [y * x * (1 - c) + z * s, c + y * y * (1 - c), y * z * (1 - c) - x * s],
        [z * x * (1 - c) - y * s, z * y * (1 - c) + x * s, c + z * z * (1 - c)],
    ]
    return [[sum(row[k] * about[k][j] for k in range(3)) for j in range(3)] for row in matrix]


def applied(matrix, vector):
    return [sum(row[k] * vector[k] for k in range(3)) for row in matrix]


def move(device, turn=(0, 0, 0), shift_m=(0, 0, 0), focal=0.0):
    pose, lens = device["world_from_device"], device["lens"]
    pose["translation_m"] = [a + b for a, b in zip(pose["translation_m"], applied(pose["rotation"], shift_m))]
    pose["rotation"] = rotated(pose["rotation"], turn)
    lens["fx"] *= 1 + focal
    lens["fy"] *= 1 + focal


def move_head(head, turn, shift_m):
    """A head that turns about the middle of its devices, about the world's axes."""
    devices = [camera["device"] for camera in head["cameras"]] + [head["projector"]]
    places = [device["world_from_device"]["translation_m"] for device in devices]
    middle = [sum(place[k] for place in places) / len(places) for k in range(3)]
    about = rotated([[1, 0, 0], [0, 1, 0], [0, 0, 1]], turn)
    for device in devices:
        pose = device["world_from_device"]
        lever = [a - b for a, b in zip(pose["translation_m"], middle)]
        pose["translation_m"] = [m + a + s for m, a, s in zip(middle, applied(about, lever), shift_m)]
        columns = list(zip(*pose["rotation"]))
        pose["rotation"] = [list(row) for row in zip(*(applied(about, column) for column in columns))]


def direction(lot):
    vector = [lot.gauss(0, 1) for _ in range(3)]
    return [x / math.sqrt(sum(x * x for x in vector)) for x in vector]


def changes():
    """Name, what the check should call it (device and kind; None: several), and what is done to a calibration."""
    heads = [(h, side) for h in range(4) for side in range(2)]

    def camera(h, side, **what):
        return lambda c: move(c["heads"][h]["cameras"][side]["device"], **what)

    def projector(h, **what):
        return lambda c: move(c["heads"][h]["projector"], **what)

    def every(lot, degree):
        def change(c):
            for head in c["heads"]:
                for device in [camera["device"] for camera in head["cameras"]] + [head["projector"]]:
                    size = math.radians(degree) * math.sqrt(3)
                    move(device, turn=[size * x for x in direction(lot)])
        return change

    def of(name, device, kind, change):
        return {"name": name, "device": device, "kind": kind, "change": change}

    lot = random.Random(56)
    cameras = lambda: lot.choice(heads)
    yield of("nothing", None, None, lambda c: None)
    for degree in (0.002, 0.005, 0.01, 0.02, 0.05):
        h, side = cameras()
        yield of(f"camera turned {degree} degree", ("camera", h, side), "turn",
                 camera(h, side, turn=[math.radians(degree) * x for x in direction(lot)]))
        h = lot.randrange(4)
        # About its rows and its line of sight a projector's light does not cross the fringes.
        yield of(f"projector turned {degree} degree", ("projector", h), "turn",
                 projector(h, turn=[0, math.radians(degree), 0]))
    for mm in (0.1, 0.3, 1.0):
        h, side = cameras()
        yield of(f"camera shifted {mm} mm", ("camera", h, side), "shift",
                 camera(h, side, shift_m=[mm * 1e-3 * x for x in direction(lot)]))
        h = lot.randrange(4)
        yield of(f"projector shifted {mm} mm", ("projector", h), "shift", projector(h, shift_m=[mm * 1e-3, 0, 0]))
    for percent in (0.02, 0.05, 0.2):
        h, side = cameras()
        yield of(f"camera's focal length {percent} %", ("camera", h, side), "focal_length",
                 camera(h, side, focal=percent / 100))
        h = lot.randrange(4)
        yield of(f"projector's focal length {percent} %", ("projector", h), "focal_length",
                 projector(h, focal=percent / 100))
    for degree in (0.005, 0.02):
        h = lot.randrange(4)
        turn = [math.radians(degree) * x for x in direction(lot)]
        shift = [degree * 0.03 * x for x in direction(lot)]
        yield of(f"head turned {degree} degree, shifted {degree * 30} mm", ("head", h), "whole",
                 lambda c, h=h, turn=turn, shift=shift: move_head(c["heads"][h], turn, shift))
    for degree in (0.002, 0.005, 0.01, 0.02):
        yield of(f"all devices turned {degree} degree rms", None, None, every(lot, degree))


def save(calibration, path):
    """Writes a calibration with its checksum, for which numbers have to look as Rust prints them."""
    def text(value):
        plain = json.dumps(value, separators=(",", ":"), sort_keys=True)
        plain = re.sub(r"-?[\d.]+e-05", lambda x: format(Decimal(x.group()), "f"), plain)
        return re.sub(r"e-0(\d)", r"e-\1", plain)
    calibration.pop("sha256", None)
    calibration["sha256"] = hashlib.sha256(text(calibration).encode()).hexdigest()
    path.write_text(text(calibration))


def run(*arguments, allowed=(0,)):
    done = subprocess.run([str(x) for x in arguments], capture_output=True, text=True)
    if done.returncode not in allowed:
        raise SystemExit(f"{' '.join(map(str, arguments))}: exit {done.returncode}: {done.stdout}{done.stderr}")
    return done


def robust(light, calibration, here):
    """Points, share of wrong ones and robust error of the clouds; the error is None where the frame set is refused."""
    shutil.rmtree(here / "result", ignore_errors=True)
    run(f"{BIN}/fourdbody", "reconstruct", light / "images", "--calibration", calibration, "--out", here / "result",
        allowed=(0, 3, 4))
    score = run(f"{BIN}/fourdbody", "validate", "truth", "--clouds", here / "result", "--truth", light / "truth",
                "--images", light / "images", "--calibration", light / "calibration.json", "--json", allowed=(0, 1, 2, 3, 4, 5))
    try:
        summary = json.loads(score.stdout)["directional"]
        return {"robust_mm": summary["robust_mm"], "points": summary["points"],
                "wrong_percent": 100 * summary["wrong_order_share"]}
    except (ValueError, KeyError, TypeError):
        return {"robust_mm": None, "points": 0, "wrong_percent": None}


def name_of(calibration, device):
    head = calibration["heads"][device[1]]
    if device[0] == "camera":
        return "camera " + head["cameras"][device[2]]["id"]
    return f"{device[0]} {head['id']}"


def called(named, row, calibration):
    """What the check's explanation is worth: of one move the device and the kind, of many their number."""
    if not row["device"]:
        return f"{len({device for device, _ in named})} devices" if named else "nothing"
    right = [name_of(calibration, row["device"]), row["kind"]]
    if named == [right]:
        return "rightly"
    devices = {device for device, _ in named}
    return "the device" if devices == {right[0]} else "others" if named else "nothing"


def measure(light, row, here):
    here.mkdir(parents=True, exist_ok=True)
    calibration = json.loads((light / "calibration.json").read_text())
    row["change"](calibration)
    changed, corrected = here / "changed.json", here / "corrected.json"
    save(calibration, changed)
    corrected.unlink(missing_ok=True)
    done = run(f"{BIN}/fourdbody", "calibration", "check", light / "images", "--calibration", changed, "--corrected",
               corrected, "--frame-sets", 1, "--json", allowed=(0, 4))
    out = {"exit": done.returncode, "before": robust(light, changed, here)}
    try:
        drift = json.loads(done.stdout)["drift"]
        named = [[x["device"], kind] for x in drift["devices"] for kind in x["kinds"]]
        out |= {"named": named, "differ_rad": drift["differ_rad"], "held_back": drift["held_back"],
                "at_body_mm": {x["device"]: x["at_body_mm"] for x in drift["devices"] if x["kinds"]},
                "called": called(named, row, calibration)}
    except (ValueError, KeyError):
        out |= {"message": done.stderr.strip().splitlines()[-1:], "called": "not measured"}
    out["written"] = corrected.exists()
    out["after"] = robust(light, corrected, here) if corrected.exists() else None
    return out


def light_of(scene):
    """The light of a scenario, one instant, as images."""
    light = OUT / "light" / pathlib.Path(scene).stem
    if not (light / "images").exists():
        shutil.rmtree(light, ignore_errors=True)
        text = re.sub(r"(?m)^instants = .*", "instants = 1", pathlib.Path(scene).read_text())
        text = re.sub(r'rig = ".*rig.toml"', f'rig = "{pathlib.Path("config/rig.toml").resolve()}"', text)
        scenario = OUT / f"{light.name}.toml"
        scenario.parent.mkdir(parents=True, exist_ok=True)
        scenario.write_text(text)
        run(f"{BIN}/fourdbody-sim", "render", "--scenario", scenario, "--out", light)
        run(f"{BIN}/fourdbody-sim", "export-png", "--frames", light, "--out", light / "images")
    return light


def alarms(light, count):
    """Of so many frame sets with noise and the true calibration: how many explained by a move, and with exit 4."""
    explained = called = 0
    for seed in range(count):
        images = OUT / "noisy"
        shutil.rmtree(images, ignore_errors=True)
        run(f"{BIN}/fourdbody-sim", "export-png", "--frames", light, "--out", images, "--noise-dn", 0.5, "--seed", seed)
        done = run(f"{BIN}/fourdbody", "calibration", "check", images, "--calibration", light / "calibration.json",
                   "--frame-sets", 1, "--json", allowed=(0, 4))
        called += done.returncode == 4
        explained += any(x["kinds"] for x in json.loads(done.stdout)["drift"]["devices"])
    return {"frame_sets": count, "with_a_move": explained, "exit_4": called}


def mm(score):
    if score is None:
        return "not written"
    return "refused" if score["robust_mm"] is None else f"{score['robust_mm']:.3f}"


def main():
    wanted = [x for x in os.environ.get("ROWS", "").split(";") if x]
    lights = [light_of(scene) for scene in os.environ.get("SCENES", SCENES).split()]
    commit = run("git", "rev-parse", "HEAD").stdout.strip()
    summary = {"commit": commit, "scenes": {}}
    for light in lights:
        print(f"| {light.name} | named | robust mm before | after |\n|---|---|---|---|")
        for row in changes():
            if wanted and not any(x in row["name"] for x in wanted):
                continue
            found = measure(light, row, OUT / "work")
            summary["scenes"].setdefault(light.name, {})[row["name"]] = found
            print(f"| {row['name']} | {found['called']} | {mm(found['before'])} | {mm(found['after'])} |", flush=True)
    count = int(os.environ.get("ALARMS", "100"))
    if count:
        summary["alarms"] = alarms(lights[0], count)
        print(summary["alarms"])
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "summary.json").write_text(json.dumps(summary, indent=1))


main()
