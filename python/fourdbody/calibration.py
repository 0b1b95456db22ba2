# SPDX-License-Identifier: MIT OR Apache-2.0
"""Calibrations: where cameras and projectors are, and what their pixels see."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _native


class Calibration:
    """A `calibration.json`, or what `content` gives with changes. Devices are named `h0_up` (cameras) and `projector h0`."""

    def __init__(self, source: str | os.PathLike[str] | Mapping[str, Any]):
        if isinstance(source, Mapping):
            self._keep(_native.Calibration.of_text(json.dumps(dict(source))))
        else:
            self._keep(_native.Calibration(os.fspath(source)))

    def _keep(self, native: _native.Calibration) -> None:
        self._native = native
        self.cameras: tuple[str, ...] = tuple(self._native.cameras())
        """Names of the cameras, in the order of camera numbers in merged clouds."""

    @classmethod
    def from_opencv(
        cls,
        *files: str | os.PathLike[str],
        rig: str | os.PathLike[str] | None = None,
        base: Calibration | None = None,
        devices: Sequence[str] = (),
        unit_mm: float | None = None,
    ) -> Calibration:
        """The calibration of OpenCV's files (YAML, XML, JSON, NPZ), of MATLAB's (JSON of `toStruct`), of Anipose's or of a scene.

        Volume, pattern and the place of the first device are those of the `rig` file, or of the calibration `base`.
        `devices`: which cameras the files' devices are in their order, or a head for its projector; empty: the cameras in
        the rig's order, then the projector. `unit_mm`: the files' unit of length, mm, where they do not state it.
        """
        paths = [os.fspath(path) for path in files]
        made = cls.__new__(cls)
        rig = None if rig is None else os.fspath(rig)
        native = None if base is None else base._native
        made._keep(_native.Calibration.of_files(paths, rig, native, list(devices), unit_mm))
        return made

    def content(self) -> dict[str, Any]:
        """The content of the file; `docs/reference/calibration.md` describes it."""
        return json.loads(self._native.text())

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes it as a file, which is never half there."""
        self._native.save(os.fspath(path))

    def size(self, device: str) -> tuple[int, int]:
        """Columns and rows of a device."""
        return self._native.device(device)[0]

    def centre_m(self, device: str) -> NDArray[np.float64]:
        """Where a device's rays begin, float64, 3, m in the world."""
        return np.array(self._native.device(device)[1])

    def rays(self, device: str, uv: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where the rays of pixels begin (3, m) and their unit directions (N x 3), both float64, in the world.

        `uv`: N x 2, columns and rows, lens distortion included. NaN where the lens has no ray.
        """
        return self.centre_m(device), self._native.directions(device, _rows(uv, 2))

    def project(self, device: str, xyz_m: ArrayLike) -> NDArray[np.float64]:
        """The pixels that see points (N x 3, m, world): float64, N x 2, also outside of the frame; NaN behind it."""
        return self._native.project(device, _rows(xyz_m, 3))


def _rows(values: ArrayLike, columns: int) -> NDArray[np.float64]:
    return np.ascontiguousarray(values, np.float64).reshape(-1, columns)
