# SPDX-License-Identifier: MIT OR Apache-2.0
"""A calibration by docs/reference/calibration.md: points to pixels and back, `read_calibration.py calibration.json`."""
import hashlib
import json
import re
import sys
import numpy as np

def load(path):
    """The calibration as a dictionary; refuses one of a later version, or that is not as it was written."""
    text = open(path, encoding="utf-8").read()
    value = json.loads(text)
    known = value.get("format") == "fourdbody-calibration" and 1 <= value["version"] <= 3
    compact = re.sub(r'("(?:[^"\\]|\\.)*")|\s+', r"\1", text).replace(f'"sha256":"{value["sha256"]}",', "", 1)
    if not known or hashlib.sha256(compact.encode()).hexdigest() != value["sha256"]:
        raise ValueError(f"{path}: no calibration of version 1 to 3, or one that was edited")
    return value

def pairs(calibration):
    """Name of each camera, camera, and projector of its head, in the order in which merged clouds number them."""
    return [(c["id"], c["device"], head["projector"]) for head in calibration["heads"] for c in head["cameras"]]

def pose(device):
    """Rotation and translation in metres, device to world."""
    return (np.array(device["world_from_device"][name], float) for name in ("rotation", "translation_m"))

def distorted(lens, x, y):
    """Coordinates behind the lens; the derivatives of the first by x, of the first by y, of the second by y."""
    (k1, k2, p1, p2, k3), r2 = lens["distortion"], x * x + y * y
    radial, slope = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + r2 * 3 * k3)
    by_x = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    by_y = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    xd, yd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return xd, yd, (by_x, 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y, by_y)

def project(device, world):
    """Pixels (u, v) of world points, an array (..., 3) in metres; NaN where the device does not see them."""
    rotation, translation = pose(device)
    lens, point = device["lens"], (np.asarray(world, float) - translation) @ rotation
    point[~(point[..., 2] > 0)] = np.nan
    x, y = point[..., 0] / point[..., 2], point[..., 1] / point[..., 2]
    (k1, k2, _, _, k3), r2, (xd, yd, _) = lens["distortion"], x * x + y * y, distorted(lens, x, y)
    unfolded = 1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3)) > 0
    pixels = np.stack([lens["fx"] * xd + lens["cx"], lens["fy"] * yd + lens["cy"]], -1)
    return np.where(unfolded[..., None], pixels, np.nan)

def sight(device, u, v):
    """Coordinates (x, y) of pixels before the lens, an array each: they see the points z (x, y, 1) of the device."""
    lens = device["lens"]
    to_x, to_y = (np.asarray(u, float) - lens["cx"]) / lens["fx"], (np.asarray(v, float) - lens["cy"]) / lens["fy"]
    x, y = to_x, to_y
    for _ in range(20):
        xd, yd, (a, b, d) = distorted(lens, x, y)
        ex, ey, determinant = xd - to_x, yd - to_y, a * d - b * b
        x, y = x - (d * ex - b * ey) / determinant, y - (a * ey - b * ex) / determinant
    xd, yd, _ = distorted(lens, x, y)
    return np.where(np.maximum(abs(xd - to_x), abs(yd - to_y)) < 1e-10, [x, y], np.nan)

if __name__ == "__main__":
    print([(name, camera["world_from_device"]["translation_m"]) for name, camera, _ in pairs(load(sys.argv[1]))])
