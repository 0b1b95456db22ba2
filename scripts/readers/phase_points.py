# SPDX-License-Identifier: MIT OR Apache-2.0
"""Points of a phase map, by docs/reference/phase-maps.md: `phase_points.py h0_up_000000.phase calibration.json`."""
import sys
import numpy as np
from read_calibration import distorted, load, pairs, pose, sight
from read_phases import read

def points(calibration, name, u, v, phase):
    """World points, m, of pixels (u, v) of a camera with absolute phases in rad; NaN where there is none."""
    _, camera, projector = next(pair for pair in pairs(calibration) if pair[0] == name)
    (r, t), (rp, tp), lens = pose(camera), pose(projector), projector["lens"]
    x, y = sight(camera, u, v)
    direction = np.stack([x, y, np.ones_like(x)], -1) @ r.T
    a, b = direction @ rp, (t - tp) @ rp
    column = phase * calibration["pattern"]["period_px"] / (2 * np.pi) - 0.5
    wanted = (column - lens["cx"]) / lens["fx"]
    p = wanted
    for _ in range(20):
        z = (b[0] - p * b[2]) / (p * a[:, 2] - a[:, 0])
        p = p - (distorted(lens, p, (z * a[:, 1] + b[1]) / (z * a[:, 2] + b[2]))[0] - wanted)
    world = t + z[:, None] * direction
    low, high = calibration["volume_min_m"], calibration["volume_max_m"]
    inside = ((low <= world) & (world <= high)).all(1) & (z > 0) & (z * a[:, 2] + b[2] > 0)
    inside &= (-0.5 <= column) & (column < projector["width"] - 0.5)
    return np.where(inside[:, None], world, np.nan)

def uncertainties(calibration, name, u, v, phase, sigma):
    """Standard uncertainties along the lines of sight, m, of phases that have these, rad."""
    ends = [points(calibration, name, u, v, phase + step) for step in (-5e-4, 5e-4)]
    return sigma * np.linalg.norm(ends[1] - ends[0], axis=1) / 1e-3

if __name__ == "__main__":
    header, u, v, phase, _, _ = read(sys.argv[1])
    found = points(load(sys.argv[2]), header["statement"]["camera"], u, v, phase)
    print(np.isfinite(found[:, 0]).sum(), "points of", len(u), "pixels; first ones, m:", found[:2].tolist())
