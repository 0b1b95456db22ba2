# SPDX-License-Identifier: MIT OR Apache-2.0
"""Points of a phase map as fourdbody's clouds have them, by the table of docs/reference/phase-maps.md.

`table_points.py h0_up_000000.phase calibration.json`; `phase_points.py` has the formula that the table stands for."""
import sys
import numpy as np
from read_calibration import load, pairs, pose, project, sight
from read_phases import read

def table(calibration, camera, projector):
    """By row and column of nodes: direction of sight (3), and inverse depth over the panel's columns (6 terms)."""
    rotation, centre = pose(camera)
    v, u = np.mgrid[:-(-camera["height"] // 8) + 1, :-(-camera["width"] // 8) + 1] * 8
    x, y = sight(camera, u, v)
    direction = np.stack([x, y, np.ones_like(x)], -1) @ rotation.T
    low, high = np.array(calibration["volume_min_m"]) - 0.1, np.array(calibration["volume_max_m"]) + 0.1
    corners = np.array(np.meshgrid(*zip(low, high))).reshape(3, -1).T
    depths = np.clip((corners - centre) @ rotation[:, 2], 0.2, None)

    def column(inverse):
        found = project(projector, centre + direction / inverse[..., None])[..., 0]
        found = (found + 0.5) / (projector["width"] / 2) - 1
        return np.where(abs(found) <= 1.2, found, np.nan)

    tried = np.linspace(1 / depths.max(), 1 / depths.min(), 17)
    lit = np.array([np.isfinite(column(np.full(u.shape, inverse))) for inverse in tried])
    first = lit.argmax(0)
    ended = ~lit & (np.arange(17)[:, None, None] > first)
    last = np.where(lit[16] | ~ended.any(0), 16, ended.argmax(0) - 1)
    places = 0.5 - 0.5 * np.cos(np.pi / 12 * (2 * np.arange(6) + 1))
    inverse = tried[first][..., None] + (tried[last] - tried[first])[..., None] * places
    columns = np.stack([column(inverse[..., j]) for j in range(6)], -1)
    known = np.isfinite(columns).all(-1) & lit.any(0)
    terms = np.full(columns.shape, np.nan)
    terms[known] = np.linalg.solve(columns[known][..., None] ** np.arange(6), inverse[known][..., None])[..., 0]
    return np.concatenate([direction, terms], -1)

def points(calibration, name, u, v, phase):
    """World points, m, of pixels (u, v) of a camera with absolute phases in rad; NaN where there is none."""
    _, camera, projector = next(pair for pair in pairs(calibration) if pair[0] == name)
    nodes, i, j = table(calibration, camera, projector).astype(np.float32), v // 8, u // 8
    s, t = ((number % 8 / 8).astype(np.float32)[:, None] for number in (u, v))
    left, right = (nodes[i, k] + t * (nodes[i + 1, k] - nodes[i, k]) for k in (j, j + 1))
    mixed = (left + s * (right - left)).astype(float)
    at = phase / (2 * np.pi) * calibration["pattern"]["period_px"] / (projector["width"] / 2) - 1
    inverse = sum(mixed[:, 3 + k] * at ** k for k in range(6))
    world = np.array(camera["world_from_device"]["translation_m"]) + mixed[:, :3] / inverse[:, None]
    inside = (np.array(calibration["volume_min_m"]) <= world) & (world <= calibration["volume_max_m"])
    return np.where((inside.all(1) & (abs(at) < 1) & (inverse > 0))[:, None], world, np.nan)

if __name__ == "__main__":
    header, u, v, phase, _, _ = read(sys.argv[1])
    found = points(load(sys.argv[2]), header["statement"]["camera"], u, v, phase)
    print(np.isfinite(found[:, 0]).sum(), "points of", len(u), "pixels; first ones, m:", found[:2].tolist())
