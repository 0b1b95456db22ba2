# SPDX-License-Identifier: MIT OR Apache-2.0
"""Calibrations: where cameras and projectors are, and what their pixels see."""

from __future__ import annotations

import json
import os

import numpy as np

from . import _native


class Calibration:
    """A `calibration.json`. Devices are named `h0_up` (cameras) and `projector h0`."""

    def __init__(self, path: str | os.PathLike):
        self._native = _native.Calibration(os.fspath(path))
        self.cameras: tuple[str, ...] = tuple(self._native.cameras())
        """Names of the cameras, in the order of camera numbers in merged clouds."""

    def content(self) -> dict:
        """The content of the file; `docs/reference/calibration.md` describes it."""
        return json.loads(self._native.text())

    def size(self, device: str) -> tuple[int, int]:
        """Columns and rows of a device."""
        return self._native.device(device)[0]

    def centre_m(self, device: str) -> np.ndarray:
        """Where a device's rays begin, float64, 3, m in the world."""
        return np.array(self._native.device(device)[1])

    def rays(self, device: str, uv) -> tuple[np.ndarray, np.ndarray]:
        """Where the rays of pixels begin (3, m) and their unit directions (N x 3), both float64, in the world.

        `uv`: N x 2, columns and rows, lens distortion included. NaN where the lens has no ray.
        """
        return self.centre_m(device), self._native.directions(device, _rows(uv, 2))

    def project(self, device: str, xyz_m) -> np.ndarray:
        """The pixels that see points (N x 3, m, world): float64, N x 2, also outside of the frame; NaN behind it."""
        return self._native.project(device, _rows(xyz_m, 3))


def _rows(values, columns: int) -> np.ndarray:
    return np.ascontiguousarray(values, np.float64).reshape(-1, columns)
