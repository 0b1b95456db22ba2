# SPDX-License-Identifier: MIT OR Apache-2.0
"""Photographs and calibrations that others published, each through one `import` and one `calibration import`.

PHOTOGRAPHS=DIR python others.py. DIR holds what is there of these; nothing is fetched:
  boards/*.jpg    the chessboards of OpenCV's samples (left01.jpg, right01.jpg, ...)
  BSC/            github.com/GeyouZhang/BSC: two cameras and a projector
  CFPE/           github.com/yongleex/CFPE: one camera
  procam-calibration/  github.com/kamino410/procam-calibration: a camera and a projector, Gray code
  caliscope/      github.com/mprib/caliscope: tests/reference/base_data/camera_array.toml
  SLMaster/       github.com/Practice3DVision/SLMaster: one camera and a projector, another time two cameras

Of SLMaster's one camera every third of its twelve photographs becomes a cloud by itself: there is no marker, the volume tells the
fringe. The reference are all twelve and the Gray code beside them. Columns are averaged in fours, since the fringes are 42 px
long. The volume was chosen by looking at the reference."""

import argparse
import json
import os
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np

import bsc

TAU = 2 * np.pi
COLUMNS, PERIOD, SHIFTS = 4, 60.0, 12  # averaged; panel px of a fringe; photographs of a period

RIG = """format = 1
name = "{name}"
trigger_rate_hz = 20.0
[volume]
min_m = {low}
max_m = {high}
[pattern]
period_px = {period}
marker_index = 20
marker = "none"
marker_strength = 0.8
marker_period_px = {period}
low = 0.0
high = 1.0
gamma = 1.0
[board]
width_m = 0.3
height_m = 0.4
pitch_m = 0.03
columns = 8
rows = 11
radius_m = 0.005
large_radius_m = 0.008
large = [[2, 5], [3, 5], [2, 7], [5, 5], [6, 2]]
[[head]]
id = "projector"
channel = "B"
delay_us = 0.0
exposure_us = 1000.0
[head.projector]
width = {panel[0]}
height = {panel[1]}
focal_px = 2500.0
position_m = [0.1, 0.0, 0.0]
look_at_m = [0.0, 1.0, 0.0]
roll_deg = 0.0
"""
CAMERA = """[[head.camera]]
id = "{id}"
node = "a"
width = {size[0]}
height = {size[1]}
focal_px = 1750.0
position_m = [0.0, 0.0, 0.0]
look_at_m = [0.0, 1.0, 0.0]
roll_deg = 0.0
"""


def rig(path, cameras, size, panel=(1920, 1080), low=(-0.2, 0.4, -0.2), high=(0.2, 0.8, 0.2), period=16.0):
    text = RIG.format(name=path.stem, low=list(low), high=list(high), period=period, panel=panel)
    path.write_text(text + "".join(CAMERA.format(id=camera, size=size) for camera in cameras))
    return path


class Runs:
    """Commands, with what they print."""

    def __init__(self, program, work):
        self.program, self.work, self.rows = program, work, []

    def __call__(self, name, *arguments):
        answer = subprocess.run([self.program, *map(str, arguments)], capture_output=True, text=True)
        lines = (answer.stdout + answer.stderr).strip().splitlines()
        print(f"{name}: {' '.join(map(str, arguments[:2]))}: exit code {answer.returncode}")
        print("\n".join(f"    {line[:160]}" for line in lines[:8]))
        self.rows.append({"name": name, "exit": answer.returncode, "said": lines})
        return answer.returncode

    def images(self, name, rig_file, images, *more):
        out = self.work / f"session-{name}"
        shutil.rmtree(out, ignore_errors=True)
        return self(name, "import", "--rig", rig_file, "--images", images, "--out", out, *more), out


def slmaster(runs, folder):
    """One camera and its projector, as they are kept and by single photographs."""
    work, panel = runs.work, (1920, 1080)
    whole = rig(work / "slm-whole.toml", ["L"], (1280, 1024))
    runs.images("slm", whole, folder, "--pattern", "{camera}/{index}")
    runs("slm", "calibration", "import", "--rig", whole, "--from", folder / "caliInfo.yml", "--unit-mm", 1,
         "--out", work / "slm-whole.json")
    photographs = [cv2.imread(str(folder / f"L/{k}.bmp"), cv2.IMREAD_GRAYSCALE) for k in range(SHIFTS + 6)]
    narrow = [x.reshape(1024, -1, COLUMNS).astype(float).mean(2) for x in photographs]
    files = cv2.FileStorage(str(folder / "caliInfo.yml"), cv2.FILE_STORAGE_READ)
    kept = {name: files.getNode(name).mat() for name in ["M1", "D1", "M4", "D4", "Rlp", "Tlp"]}
    kept["M1"][0] /= COLUMNS
    kept["M1"][0, 2] += (1 - COLUMNS) / (2 * COLUMNS)
    # Where our first ridge is they are darkest: half a period away, and pixels are counted from their middles.
    centre = kept["M4"][0, 2] - PERIOD / 2 - 0.5
    bench = rig(work / "slm.toml", ["L"], (320, 1024), panel, *VOLUME, PERIOD)
    wrong, off, shares, depths = [], [], [], []
    for k in range(0, SHIFTS, 3):
        # Photograph k has its fringes k twelfths of a period nearer to column 0.
        kept["M4"][0, 2] = centre + PERIOD * k / SHIFTS
        storage = cv2.FileStorage(str(work / "slm.yml"), cv2.FILE_STORAGE_WRITE)
        [storage.write(name, value) for name, value in kept.items()]
        storage.release()
        images = work / "slm-images/L"
        shutil.rmtree(images, ignore_errors=True)
        images.mkdir(parents=True)
        cv2.imwrite(str(images / "0.png"), np.round(narrow[k]).astype(np.uint8))
        _, session = runs.images("slm-one", bench, images.parent)
        calibration, out = work / "slm.json", work / "slm-clouds"
        runs("slm-one", "calibration", "import", "--rig", bench, "--from", work / "slm.yml", "--unit-mm", 1,
             "--out", calibration)
        shutil.rmtree(out, ignore_errors=True)
        runs("slm-one", "reconstruct", session, "--calibration", calibration, "--out", out, "--format", "ply")
        clouds = sorted(out.glob("clouds/L*.ply"))
        if not clouds:
            continue
        cloud = bsc.read_ply(clouds[0])
        points = np.stack([cloud[axis] for axis in "xyz"], 1).astype(float)
        phase, known = reference(narrow)
        u, v = cloud["u"].astype(int), cloud["v"].astype(int)
        device = json.loads(calibration.read_text())["heads"][0]["projector"]
        column = lambda x: project(device, x) - (PERIOD * k / SHIFTS - PERIOD / 2 - 0.5)
        here = column(points)
        per_mm = column(points * (1 + 1e-3 / np.linalg.norm(points, axis=1, keepdims=True))) - here
        differ = (phase[v, u] * PERIOD / TAU - here)[known[v, u]]
        wrong.append(np.mean(np.abs(differ) > PERIOD / 2))
        right = np.abs(differ) < PERIOD / 2
        off.append(np.median(np.abs(differ / per_mm[known[v, u]])[right]))
        shares.append(len(points) / known.sum())
        depths += list(points[:, 1])
    if wrong:
        low, high = np.percentile(depths, [1, 99])
        print(f"{len(wrong)} single photographs against {SHIFTS} and Gray code, the worst: wrong fringes "
              f"{100 * max(wrong):.2f} %, median {max(off):.2f} mm, complete {100 * min(shares):.0f} %, "
              f"at {low:.3f} to {high:.3f} m")


def reference(images):
    """Absolute phase, rad, of their panel columns (0 at column 0), and where there is one, as SLMaster decodes it."""
    steps = np.stack(images[:SHIFTS])
    turns = np.exp(1j * TAU * np.arange(SHIFTS) / SHIFTS)[:, None, None]
    sums = (steps * turns).mean(0)
    wrapped, light = -np.angle(sums), steps.mean(0)
    bits = np.cumsum([image > light for image in images[SHIFTS:]], axis=0) % 2
    first = sum(bit.astype(int) << (4 - i) for i, bit in enumerate(bits[:5]))
    second = (2 * first + bits[5] + 1) // 2
    order = np.where(wrapped <= -np.pi / 2, second, np.where(wrapped >= np.pi / 2, second - 1, first))
    return wrapped + np.pi + TAU * order, 2 * np.abs(sums) > 10.0


def project(device, points):
    """Columns of a device of a calibration at which world points are seen."""
    pose, lens = device["world_from_device"], device["lens"]
    seen = (points - pose["translation_m"]) @ np.array(pose["rotation"])
    matrix = np.array([[lens["fx"], 0, lens["cx"]], [0, lens["fy"], lens["cy"]], [0, 0, 1.0]])
    return cv2.projectPoints(seen, np.zeros(3), np.zeros(3), matrix, np.array(lens["distortion"]))[0][:, 0, 0]


VOLUME = ((-0.2, 0.690, -0.2), (0.2, 0.780, 0.2))

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=Path, default=os.environ.get("PHOTOGRAPHS"))
    parser.add_argument("--fourdbody", type=Path, default="target/release/fourdbody")
    parser.add_argument("--work", type=Path, default="target/others")
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    if options.sets is None:
        parser.error("expected a directory of sets in $PHOTOGRAPHS or --sets, found none")
    runs, sets = Runs(options.fourdbody, options.work), Path(options.sets)
    if (sets / "boards").is_dir():
        pair = rig(options.work / "boards.toml", ["left", "right"], (640, 480))
        runs.images("boards", pair, sets / "boards", "--pattern", "{camera}{index}", "--renumber")
    if (sets / "BSC").is_dir():
        pair = rig(options.work / "bsc.toml", ["1_Rectified", "2_Rectified"], (640, 480), (1280, 1024))
        runs.images("bsc", pair, sets / "BSC/Data/Hand")
    if (sets / "CFPE").is_dir():
        one = rig(options.work / "cfpe.toml", ["eye"], (640, 480))
        runs.images("cfpe", one, sets / "CFPE/data/recordings/2", "--pattern", "{index}h", "--renumber")
    if (sets / "procam-calibration").is_dir():
        folder = sets / "procam-calibration/sample_data"
        one = rig(options.work / "procam.toml", ["eye"], (1280, 1024), (1024, 768))
        runs.images("procam", one, folder / "capture_0", "--pattern", "graycode_{index}")
        runs("procam", "calibration", "import", "--rig", one, "--from", folder / "calibration_result.xml", "--unit-mm", 1,
             "--out", options.work / "procam.json")
    if (sets / "caliscope").is_dir():
        room = rig(options.work / "room.toml", ["west", "east"], (1280, 720))
        runs("caliscope", "calibration", "import", "--rig", room, "--from", sets / "caliscope/camera_array.toml",
             "--unit-mm", 1000, "--out", options.work / "room.json")
    if (sets / "SLMaster").is_dir():
        folder = sets / "SLMaster/data/binocularCamera"
        pair = rig(options.work / "slm-pair.toml", ["L", "R"], (1280, 1024))
        runs.images("slm-pair", pair, folder)
        runs("slm-pair", "calibration", "import", "--rig", pair, "--from", folder / "caliInfo.yml", "--unit-mm", 1,
             "--devices", "L,R", "--out", options.work / "slm-pair.json")
        slmaster(runs, sets / "SLMaster/data/monocularCamera")
