# SPDX-License-Identifier: MIT OR Apache-2.0
"""Photographs of fringes to points."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import _native
from .calibration import Calibration
from .clouds import Cloud, cloud_of
from .result import Result
from .session import Session


@dataclass(frozen=True)
class FrameSet:
    """What the photographs of one instant have become."""

    merged: Cloud
    """One cloud of all cameras."""
    clouds: dict[str, Cloud]
    """The cloud of each camera; empty where its photograph was refused."""
    refused: dict[str, str]
    """Why a photograph gave no points."""


class Reconstructor:
    """Reconstructs the photographs that cameras of one calibration take at one instant.

    Making one takes about a second; keep it. Work runs on all processors without the interpreter's lock.
    """

    def __init__(self, calibration: Calibration):
        self._native = _native.Reconstructor(calibration._native)
        self.cameras = calibration.cameras
        """Names of the cameras, in the order of camera numbers in merged clouds."""

    def __call__(self, images: Mapping[str, NDArray[np.uint8]]) -> FrameSet:
        """The points of one instant, in the world of the calibration.

        Args:
            images: uint8, rows x columns, by camera. Cameras may be missing; each confirms the others' fringe orders.
        """
        given = {camera: np.ascontiguousarray(image) for camera, image in images.items()}
        for camera, image in given.items():
            if image.dtype != np.uint8 or image.ndim != 2:
                raise TypeError(f"expected uint8, rows x columns, found {image.dtype} {image.shape} for {camera}")
        clouds, merged = self._native.reconstruct(given)
        return FrameSet(
            cloud_of(merged, self.cameras),
            {camera: cloud_of(arrays, (camera,)) for camera, (arrays, _) in clouds.items()},
            {camera: reason for camera, (_, reason) in clouds.items() if reason is not None},
        )


def reconstruct_images(images: Mapping[str, NDArray[np.uint8]], calibration: Calibration) -> FrameSet:
    """The photographs of one instant to points, in memory. For more than one instant keep a Reconstructor."""
    return Reconstructor(calibration)(images)


def reconstruct(
    session: Session,
    calibration: Calibration,
    out: str | os.PathLike[str],
    *,
    triggers: range | None = None,
    cameras: Iterable[str] = (),
    uncertainty: bool = False,
    clouds: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Result:
    """Reconstructs a session into the directory `out`, as `fourdbody reconstruct` does, and opens the result.

    What is there of the same session and calibration is kept. Ctrl-C ends the work after the triggers that are under way.

    Args:
        session: The session with the photographs.
        calibration: That of the session's rig; it defines the world.
        out: The directory of the result.
        triggers: Consecutive ones; all by default.
        cameras: Their names; all by default.
        uncertainty: Of each point the standard uncertainty, too.
        clouds: Also write PLY files, not only phase maps.
        progress: Is called with triggers done and their number.

    Raises:
        Error: The session and the calibration do not belong together, or the directory has another result.
    """
    if triggers is not None and (triggers.step != 1 or len(triggers) == 0):
        raise ValueError(f"expected consecutive triggers, found {triggers}")
    bounds = None if triggers is None else (triggers.start, triggers.stop)
    _native.reconstruct(session.path, calibration._native, os.fspath(out), bounds, list(cameras), uncertainty, clouds, progress)
    return Result(out)
