# SPDX-License-Identifier: MIT OR Apache-2.0
"""A hand that moves and a statue, photographed by others: our clouds of single photographs against many photographs' phase.

python bsc.py --data DIR --fourdbody PROGRAM --work DIR --out bsc.json. DIR is a clone of github.com/GeyouZhang/BSC: two cameras
and a projector, 100 photographs of each camera and object, fringes shifted by a quarter from one to the next, and the matrices
of the three devices. There is no marker: the fringe orders are found from the two cameras alone.

Each photograph goes through `fourdbody reconstruct` alone. The reference is made of nine photographs around it, by the authors'
method (binomial self-compensation, order five): six phases of four photographs each, averaged with binomial weights, which
takes away what an even motion does to phase shifting. Its fringe orders are those at which both cameras see the same phase.

The two cameras disagree by the authors' matrices. `fourdbody calibration check` finds how the devices have moved, from
photographs of the hand that are not scored; all figures are given with the matrices as they are, and moved back.

Their fringes are 35 to 60 px long, ours are made for 5 to 24: columns are averaged in fours, in what both methods see."""

import argparse
import copy
import hashlib
import json
import shutil
import subprocess
from math import comb
from pathlib import Path

import cv2
import numpy as np
import scipy.io
import scipy.linalg
from scipy.ndimage import median_filter, uniform_filter
from scipy.spatial import cKDTree

TAU = 2.0 * np.pi
FRINGES, PANEL = 28.5, (1280, 1024)  # of the authors' program
PERIOD = PANEL[0] / FRINGES
COLUMNS = 4  # averaged
ORDER = 5  # of the binomial; the middle of ORDER + 4 photographs is one of them
SHIFTS = 4
DARK = 15.0  # least modulation of the authors' program, grey values
VOLUME_MM = np.array([[-110.0, -130.0, -110.0], [60.0, 40.0, 20.0]])  # the authors' depths, and what the cameras see of them
CAMERAS = {"left": ("1_Rectified", "mCamera1Rectified"), "right": ("2_Rectified", "mCamera2Rectified")}


def wrap(x):
    return x - TAU * np.round(x / TAU)


class Device:
    """A pinhole of a projection matrix (mm, pixels counted from one), whose columns are averaged in groups."""

    def __init__(self, matrix, columns=1):
        shift = np.array([[1, 0, -1], [0, 1, -1], [0, 0, 1.0]])  # pixels counted from nought
        group = np.array([[1 / columns, 0, (1 - columns) / (2 * columns)], [0, 1, 0], [0, 0, 1.0]])
        self.matrix = group @ shift @ matrix
        if np.linalg.det(self.matrix[:, :3]) < 0:
            self.matrix = -self.matrix
        lens, rotation = scipy.linalg.rq(self.matrix[:, :3])
        signs = np.diag(np.sign(np.diag(lens)))
        self.lens, self.rotation = lens @ signs, signs @ rotation
        self.lens /= self.lens[2, 2]
        self.centre = np.linalg.solve(self.matrix[:, :3], -self.matrix[:, 3])

    def moved(self, before, after):
        """As a calibration has moved it: its poses in the calibrations before and after, as `json` writes them."""
        result = copy.copy(self)
        rotation = [np.array(pose["rotation"]) for pose in (before, after)]
        result.rotation = rotation[1].T @ rotation[0] @ self.rotation
        result.centre = self.centre + 1e3 * (np.array(after["translation_m"]) - np.array(before["translation_m"]))
        result.matrix = self.lens @ np.column_stack([result.rotation, -result.rotation @ result.centre])
        return result

    def json(self, width, height, shift_px=0.0):
        """As a calibration has it. A skew of some pixels a thousand becomes a turn about the axis: only columns matter."""
        fx, skew, fy = self.lens[0, 0], self.lens[0, 1], self.lens[1, 1]
        turn = skew / fx
        about = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        lens = {"fx": fx, "fy": fy, "cx": self.lens[0, 2] + shift_px, "cy": self.lens[1, 2], "distortion": [0.0] * 5}
        pose = {"rotation": (about @ self.rotation).T.tolist(), "translation_m": (self.centre / 1e3).tolist()}
        return {"width": width, "height": height, "lens": lens, "world_from_device": pose}

    def project(self, points_mm):
        seen = points_mm @ self.matrix[:, :3].T + self.matrix[:, 3]
        return seen[..., :2] / seen[..., 2:]


def compact(value):
    """JSON as the program writes it, so that its checksum is the same: sorted, no spaces, no exponents."""
    if isinstance(value, dict):
        return "{" + ",".join(f"{json.dumps(k)}:{compact(value[k])}" for k in sorted(value)) + "}"
    if isinstance(value, list):
        return "[" + ",".join(map(compact, value)) + "]"
    if isinstance(value, float):
        return np.format_float_positional(value if abs(value) >= 1e-5 else 0.0, trim="0")
    return json.dumps(value)


def calibration(devices, size, shift):
    """The head as a calibration: in photograph `shift` the fringes lie so many quarters of a period further."""
    width, height = size
    cameras = [{"id": name, "device": devices[name].json(width, height)} for name in CAMERAS]
    projector = devices["projector"].json(*PANEL, shift_px=0.5 - shift * PERIOD / SHIFTS)
    content = {
        "format": "fourdbody-calibration", "version": 3, "rig": "bsc", "origin": "the authors' matrices",
        "heads": [{"id": "h0", "channel": "B", "projector": projector, "cameras": cameras}],
        # Beyond the panel: these photographs have no marker.
        "pattern": {"period_px": PERIOD, "marker_index": 1000000, "marker": {"darkened": {"depth": 0.8}},
                    "marker_period_px": PERIOD, "low": 0.0, "high": 1.0, "gamma": 1.0},
        "volume_min_m": (VOLUME_MM[0] / 1e3).tolist(), "volume_max_m": (VOLUME_MM[1] / 1e3).tolist(),
    }
    content["sha256"] = hashlib.sha256(compact(content).encode()).hexdigest()
    return compact(content)


def photographs(folder):
    """All of one camera, columns averaged (8 bits again, as a camera would give them)."""
    whole = np.stack([cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(folder.glob("*.bmp"))])
    groups = whole.reshape(*whole.shape[:2], -1, COLUMNS).astype(float).mean(3)
    return np.round(groups).astype(np.uint8)


def many_photographs_phase(images, middle):
    """Phase (of the pattern of photograph 0) and modulation from ORDER + 4 photographs around one."""
    first = middle - (ORDER + 3) // 2
    images = images.astype(float)
    total, modulation, base = 0.0, 0.0, None
    for k in range(ORDER + 1):
        i = images[first + k : first + k + 4]
        phase = np.arctan2(i[1] - i[3], i[0] - i[2]) + (first + k) * TAU / 4
        base = phase if base is None else base
        weight = comb(ORDER, k) / 2**ORDER
        total = total + weight * wrap(phase - base)
        modulation = modulation + weight * np.hypot(i[1] - i[3], i[0] - i[2]) / 2
    return np.where(modulation >= DARK, wrap(base + total), np.nan), modulation


def depths(camera, projector, phase):
    """World points (mm) of each pixel at every whole fringe: orders x rows x columns x 3, NaN outside the volume."""
    v, u = np.mgrid[: phase.shape[0], : phase.shape[1]]
    result = np.full((int(FRINGES) + 1, *phase.shape, 3), np.nan)
    for order in range(len(result)):
        x = (phase / TAU + order) * PERIOD - 1  # the authors count panel columns from one
        rows = [camera.matrix[0] - u[..., None] * camera.matrix[2], camera.matrix[1] - v[..., None] * camera.matrix[2],
                projector.matrix[0] - x[..., None] * projector.matrix[2]]
        system = np.stack(rows, axis=-2)
        known = np.isfinite(phase)
        point = np.linalg.solve(system[known][..., :3], -system[known][..., 3:])[..., 0]
        point[((point < VOLUME_MM[0]) | (point > VOLUME_MM[1])).any(1)] = np.nan
        result[order][known] = point
    return result


def settled(points, phase_elsewhere, elsewhere, projector):
    """Of each pixel's candidates the one at which the other camera sees the same phase over a window of 3 x 13 pixels."""
    worst = []
    for point in points:
        at = elsewhere.project(point)
        known = np.isfinite(at).all(-1)
        seen = cv2.remap(np.cos(phase_elsewhere).astype(np.float32), *(at.astype(np.float32)[..., k] for k in (0, 1)), cv2.INTER_LINEAR, borderValue=np.nan)
        seen_y = cv2.remap(np.sin(phase_elsewhere).astype(np.float32), *(at.astype(np.float32)[..., k] for k in (0, 1)), cv2.INTER_LINEAR, borderValue=np.nan)
        phase = (projector.project(point)[..., 0] + 1) / PERIOD * TAU
        off = np.abs(wrap(np.arctan2(seen_y, seen) - phase))
        good = known & np.isfinite(off)
        share = uniform_filter(good.astype(float), (13, 3))
        mean = uniform_filter(np.where(good, off, 0.0), (13, 3)) / np.maximum(share, 1e-9)
        worst.append(np.where(known & (share > 0.5), mean, np.inf))
    worst = np.stack(worst)
    best = worst.argmin(0)
    result = np.take_along_axis(points, best[None, ..., None], 0)[0]
    result[~np.isfinite(worst.min(0))] = np.nan
    # As the authors': what lies 2 mm off the middle of its surroundings is taken for wrong.
    z = np.where(np.isfinite(result[..., 2]), result[..., 2], 0.0)
    result[np.abs(z - median_filter(z, (25, 7))) > 2.0] = np.nan
    return result


def read_ply(path):
    with open(path, "rb") as file:
        names, count = [], 0
        kinds = {"float": "<f4", "double": "<f8", "ushort": "<u2", "uchar": "u1"}
        while (line := file.readline().strip().decode()) != "end_header":
            words = line.split()
            if words[:2] == ["element", "vertex"]:
                count = int(words[2])
            elif words[0] == "property":
                names.append((words[2], kinds[words[1]]))
        return np.frombuffer(file.read(), dtype=names, count=count)


def between(one, other, normals):
    """Distances (mm) of points to planes at the nearest points of another cloud, of those with a neighbour within 1.5 mm."""
    if len(one) == 0 or len(other) == 0:
        return np.zeros(0)
    near, index = cKDTree(other).query(one)
    close = near < 1.5
    return ((one - other[index]) * normals[index])[close].sum(1)


def spread(values):
    """Median, robust deviation (1.4826 x median of absolute deviations) and 95th percentile of absolute values."""
    if len(values) == 0:
        return None
    middle = float(np.median(values))
    return {"count": len(values), "median": middle, "robust": float(1.4826 * np.median(np.abs(values - middle))),
            "p95": float(np.percentile(np.abs(values - middle), 95))}


def write_pair(folder, images, middles, devices, shift):
    """Photographs of both cameras, numbered, and the calibration that is theirs; its path and that of the images."""
    height, width = images["left"].shape[1:]
    for camera in CAMERAS:
        (folder / "images" / camera).mkdir(parents=True)
        for index, middle in enumerate(middles):
            cv2.imwrite(str(folder / "images" / camera / f"{index}.png"), images[camera][middle])
    (folder / "calibration.json").write_text(calibration(devices, (width, height), shift))
    return folder / "images", folder / "calibration.json"


def moved_back(devices, images, program, work, step):
    """The devices where `fourdbody calibration check` finds them, from photographs that are not scored, and its answer."""
    shutil.rmtree(work, ignore_errors=True)
    others = [k for k in range(0, len(images["left"]), SHIFTS) if k not in scored(images, step)]
    pair, before = write_pair(work, images, others, devices, 0)
    after = work / "corrected.json"
    answer = subprocess.run([program, "calibration", "check", pair, "--calibration", before, "--corrected", after,
                             "--frame-sets", str(len(others)), "--json"],
                            capture_output=True, text=True)
    if not after.exists():
        print(f"fourdbody does not find how the devices have moved: {answer.stderr.strip()}")
        return None, None
    heads = [json.loads(path.read_text())["heads"][0] for path in (before, after)]
    poses = lambda head: {"projector": head["projector"]} | {camera["id"]: camera["device"] for camera in head["cameras"]}
    before, after = (poses(head) for head in heads)
    result = {
        name: device.moved(before[name]["world_from_device"], after[name]["world_from_device"])
        for name, device in devices.items()
    }
    return result, json.loads(answer.stdout)


def scored(images, step):
    return range(ORDER, len(images["left"]) - ORDER, step)


def one_object(images, devices, program, work, step):
    middles = scored(images, step)
    shutil.rmtree(work, ignore_errors=True)
    clouds, refused = {}, 0
    for shift in range(SHIFTS):
        here = work / str(shift)
        mine = [middle for middle in middles if middle % SHIFTS == shift]
        if not mine:
            continue
        pair, file = write_pair(here, images, mine, devices, shift)
        answer = subprocess.run([program, "reconstruct", pair, "--calibration", file,
                                 "--out", here / "out", "--format", "ply", "--json"], capture_output=True, text=True)
        (here / "answer.txt").write_text(answer.stdout + answer.stderr)
        for index, middle in enumerate(mine):
            for camera in CAMERAS:
                cloud = here / "out" / "clouds" / f"{camera}_{index:06}.ply"
                clouds[camera, middle] = read_ply(cloud) if cloud.exists() and len(read_ply(cloud)) else None
                refused += clouds[camera, middle] is None
    errors, agreement, theirs, counts, wrong = [], [], [], np.zeros(4), []
    for middle in middles:
        phase = {camera: many_photographs_phase(images[camera], middle)[0] for camera in CAMERAS}
        truth = {}
        for camera, other in (("left", "right"), ("right", "left")):
            candidates = depths(devices[camera], devices["projector"], phase[camera] % TAU)
            truth[camera] = settled(candidates, phase[other], devices[other], devices["projector"])
        for camera in CAMERAS:
            cloud, true = clouds[camera, middle], truth[camera]
            counts[0] += np.isfinite(true[..., 2]).sum()
            if cloud is None:
                continue
            points = 1e3 * np.stack([cloud["x"], cloud["y"], cloud["z"]], 1).astype(float)
            at = true[cloud["v"], cloud["u"]]
            both = np.isfinite(at[:, 2])
            panel = [devices["projector"].project(p[both])[:, 0] for p in (points, at)]
            error = (panel[0] - panel[1]) / PERIOD * TAU
            wrong.append(int((np.abs(error) > np.pi).sum()))
            counts[1:] += [both.sum(), wrong[-1], len(points)]
            errors.append(error[np.abs(error) <= np.pi])
        if clouds["left", middle] is not None and clouds["right", middle] is not None:
            sides = [1e3 * np.stack([clouds[c, middle][k] for k in "xyz"], 1).astype(float) for c in CAMERAS]
            normal = np.stack([clouds["right", middle][k] for k in ("nx", "ny", "nz")], 1).astype(float)
            agreement.append(between(*sides, normal))
            sides = [truth[c][np.isfinite(truth[c][..., 2])] for c in CAMERAS]
            _, index = cKDTree(1e3 * np.stack([clouds["right", middle][k] for k in "xyz"], 1)).query(sides[1])
            theirs.append(between(*sides, normal[index]))
    joined = lambda parts: np.concatenate(parts) if parts else np.zeros(0)
    return {
        "photographs": 2 * len(middles), "photographs_refused": refused, "reference_points": int(counts[0]),
        "complete": float(counts[1] / counts[0]), "wrong_order_share": float(counts[2] / max(counts[1], 1)),
        "wrong_in_worst_photograph_share": max(wrong, default=0) / max(sum(wrong), 1), "points": int(counts[3]), "phase_rad": spread(joined(errors)),
        "left_to_right_mm": spread(joined(agreement)), "left_to_right_reference_mm": spread(joined(theirs)),
    }


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--fourdbody", required=True)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--step", type=int, default=3, help="every so many photographs")
    args = parser.parse_args()
    matrix = lambda file: scipy.io.loadmat(args.data / "Data" / f"{file}.mat")[file]
    devices = {camera: Device(matrix(file), COLUMNS) for camera, (_, file) in CAMERAS.items()}
    devices["projector"] = Device(matrix("mProjector"))
    images = {name: {camera: photographs(args.data / "Data" / name / folder) for camera, (folder, _) in CAMERAS.items()}
              for name in ("Statue", "Hand")}
    report = {}
    moved, check = moved_back(devices, images["Hand"], args.fourdbody, args.work / "check", args.step)
    print("calibration check, photographs of the hand:", json.dumps(check))
    for ending, those in (("", devices), ("_moved_back", moved)):
        for name, photos in images.items():
            if those:
                key = name.lower() + ending
                report[key] = one_object(photos, those, args.fourdbody, args.work / key, args.step)
                print(key, json.dumps(report[key], indent=1))
    args.out.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
