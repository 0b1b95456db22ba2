# SPDX-License-Identifier: MIT OR Apache-2.0
"""Clouds of points and phase maps, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Cloud:
    """Points of one instant, of one camera or of all.

    Arrays have one entry for each of N points, in an order that equal inputs give again.
    """

    xyz_m: NDArray[np.float32]
    """Places in the world, float32, N x 3, m."""
    normal: NDArray[np.float32]
    """Unit normals towards the camera, in the world, float32, N x 3."""
    intensity: NDArray[np.float32]
    """Light averaged over one fringe, float32, N, from 0 to 1."""
    uv: NDArray[np.uint16]
    """Column and row of the pixel in its frame, uint16, N x 2."""
    sigma_m: NDArray[np.float32] | None
    """Standard uncertainty along the line of sight, float32, N, m; None where it was not computed."""
    camera: NDArray[np.uint8] | None
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

    def at(self, uv: ArrayLike, reach_px: float = 3.0) -> NDArray[np.float64]:
        """Where pixels lie in the world, by the points about them, float64, M x 3, m; NaN where there are none.

        For the cloud of one camera: what was found in its image becomes places in space.

        Args:
            uv: M x 2, columns and rows in the camera's frame.
            reach_px: Points that are no further than this count, px; the median of each coordinate is taken.

        Raises:
            ValueError: The cloud is of several cameras.
        """
        if self.camera is not None:
            raise ValueError("this cloud is of several cameras; `at` needs that of one: result.cloud(trigger, camera)")
        places = np.full((len(pixels := np.asarray(uv, np.float64).reshape(-1, 2)), 3), np.nan)
        for place, pixel in zip(places, pixels):
            near = np.square(self.uv - pixel).sum(1) <= reach_px**2
            if near.any():
                place[:] = np.median(self.xyz_m[near], 0)
        return places

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

    uv: NDArray[np.uint16]
    """Column and row, uint16, N x 2, row by row."""
    fringes: NDArray[np.float64]
    """Absolute phase, float64, N, fringes from the panel's edge: the panel's column is fringes * period_px - 0.5."""
    light_dn: NDArray[np.float32]
    """Light averaged over one fringe, float32, N, grey values."""
    sigma_rad: NDArray[np.float32] | None
    """Standard uncertainty of the phase, float32, N, rad; None where it was not computed."""
    size: tuple[int, int]
    """Columns and rows of the frame."""

    def image(self) -> NDArray[np.float64]:
        """The phase in fringes as an image, float64, rows x columns; NaN where it is not known."""
        image = np.full(self.size[::-1], np.nan)
        image[self.uv[:, 1], self.uv[:, 0]] = self.fringes
        return image

    def light_image(self) -> NDArray[np.uint8]:
        """The photograph without its fringes, uint8, rows x columns, grey values; 0 where the phase is not known."""
        image = np.zeros(self.size[::-1], np.uint8)
        image[self.uv[:, 1], self.uv[:, 0]] = np.rint(self.light_dn)
        return image


def cloud_of(
    arrays: dict[str, Any], cameras: tuple[str, ...], trigger: int | None = None, comments: Sequence[str] = ()
) -> Cloud:
    """A cloud of the native arrays."""
    stated = [comment.split()[1] for comment in comments if comment.startswith("time_ns ")]
    time_ns = int(stated[0]) if stated else None
    return Cloud(**arrays, cameras=cameras, trigger=trigger, time_ns=time_ns, comments=tuple(comments))
