# SPDX-License-Identifier: MIT OR Apache-2.0
"""Clouds of points and phase maps, as arrays."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Cloud:
    """Points of one instant, of one camera or of all.

    Arrays have one entry for each of N points, in an order that equal inputs give again.
    """

    xyz_m: np.ndarray
    """Places in the world, float32, N x 3, m."""
    normal: np.ndarray
    """Unit normals towards the camera, float32, N x 3."""
    intensity: np.ndarray
    """Light averaged over one fringe, float32, N, from 0 to 1."""
    uv: np.ndarray
    """Column and row of the pixel in its frame, uint16, N x 2."""
    sigma_m: np.ndarray | None
    """Standard uncertainty along the line of sight, float32, N, m; None where it was not computed."""
    camera: np.ndarray | None
    """Of a merged cloud: the camera's place in `cameras`, uint8, N; None in the cloud of one camera."""
    cameras: tuple[str, ...] = ()
    """Names of the cameras, in the order of their numbers."""
    trigger: int | None = None
    """The trigger index of the instant."""
    time_ns: int | None = None
    """When it was, ns since 1970 on the clock `Session.time_base`; None where that is not known."""
    comments: tuple[str, ...] = field(default=(), repr=False)
    """The comments of the stored file: program, parameters, session, times."""

    def __len__(self) -> int:
        return len(self.xyz_m)

    def of_camera(self, name: str) -> Cloud:
        """The points of one camera of a merged cloud."""
        if self.camera is None:
            raise ValueError("this cloud is of one camera; of_camera needs a merged cloud")
        chosen = self.camera == self.cameras.index(name)
        sigma_m = None if self.sigma_m is None else self.sigma_m[chosen]
        return Cloud(self.xyz_m[chosen], self.normal[chosen], self.intensity[chosen], self.uv[chosen], sigma_m, None,
                     (name,), self.trigger, self.time_ns, self.comments)


@dataclass(frozen=True)
class PhaseMap:
    """The known pixels of one frame with their absolute phase: the calibration turns them into points."""

    uv: np.ndarray
    """Column and row, uint16, N x 2, row by row."""
    fringes: np.ndarray
    """Absolute phase, float64, N, fringes from the panel's edge: the panel's column is fringes * period_px - 0.5."""
    light_dn: np.ndarray
    """Light averaged over one fringe, float32, N, grey values."""
    sigma_rad: np.ndarray | None
    """Standard uncertainty of the phase, float32, N, rad; None where it was not computed."""
    size: tuple[int, int]
    """Columns and rows of the frame."""

    def image(self) -> np.ndarray:
        """The phase in fringes as an image, float64, rows x columns; NaN where it is not known."""
        image = np.full(self.size[::-1], np.nan)
        image[self.uv[:, 1], self.uv[:, 0]] = self.fringes
        return image


def cloud_of(arrays: dict, cameras: tuple[str, ...], trigger: int | None = None, comments=()) -> Cloud:
    """A cloud of the native arrays."""
    stated = [comment.split()[1] for comment in comments if comment.startswith("time_ns ")]
    time_ns = int(stated[0]) if stated else None
    return Cloud(**arrays, cameras=cameras, trigger=trigger, time_ns=time_ns, comments=tuple(comments))
