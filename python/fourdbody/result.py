# SPDX-License-Identifier: MIT OR Apache-2.0
"""What `fourdbody reconstruct` wrote: clouds and phase maps."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from . import _native
from .calibration import Calibration
from .clouds import Cloud, PhaseMap, cloud_of

if TYPE_CHECKING:
    import rerun


class Result:
    """A directory that `reconstruct` wrote. Clouds are made of the stored phase maps when they are asked for.

    Each file is compared with its name, its session and `summary.json`; a file of something else raises Error (code 4).
    """

    def __init__(self, path: str | os.PathLike[str]):
        self._native = _native.Result(os.fspath(path))
        self.path = Path(path)
        """The directory."""
        self.triggers: tuple[int, ...] = tuple(self._native.triggers())
        """The triggers that have a cloud, in order."""
        summary = self.path / "summary.json"
        self.summary: dict[str, Any] = json.loads(summary.read_text()) if summary.exists() else {}
        """What became of each frame; `docs/reference/summary.md` describes it."""

    def __repr__(self) -> str:
        return f"<Result {self.path}: {len(self.triggers)} triggers>"

    def __len__(self) -> int:
        return len(self.triggers)

    def __iter__(self) -> Iterator[Cloud]:
        """The merged clouds, in order; each is made when it is its turn."""
        return (self.cloud(trigger) for trigger in self.triggers)

    @cached_property
    def calibration(self) -> Calibration:
        """The calibration that the result was made with."""
        return Calibration(self.path / "calibration.json")

    def cloud(self, trigger: int, camera: str | None = None) -> Cloud:
        """The cloud of a trigger: of one camera, or merged. The very points that `fourdbody export` writes."""
        found = self._native.cloud(trigger, camera)
        if found is None:
            of = "" if camera is None else f" of camera {camera!r}"
            raise KeyError(f"there is no cloud{of} of trigger {trigger}; `triggers` has those that there are")
        arrays, comments = found
        cameras = self.calibration.cameras if camera is None else (camera,)
        return cloud_of(arrays, cameras, trigger, comments)

    def phase(self, trigger: int, camera: str) -> PhaseMap:
        """The stored phase map of a frame."""
        found = self._native.phase(trigger, camera)
        if found is None:
            raise KeyError(f"there is no phase map of trigger {trigger} and camera {camera!r}")
        return PhaseMap(**found)

    def to_rerun(self, points: int = 150_000, *, recording: rerun.RecordingStream | None = None) -> None:
        """Logs the merged clouds to Rerun as the entity `body`, in metres, z up, grey by their intensity.

        They stand on two time lines: `trigger`, the trigger indexes, and `session_time`, when the triggers were, on the
        clock `time_base` of the summary. Needs `pip install rerun-sdk`.

        Args:
            points: Points of a frame set at most; of more, evenly chosen ones are logged.
            recording: Where to log to; the active recording by default.

        Raises:
            ImportError: Rerun is not installed.
            ValueError: `points` is not above 0.

        Examples:
            >>> import rerun as rr
            >>> rr.init("walk-01", spawn=True)             # or rr.init("walk-01"); rr.save("walk-01.rrd")
            >>> result.to_rerun()
        """
        if points < 1:
            raise ValueError(f"expected points above 0, found {points}")
        try:
            import rerun as rr
        except ImportError as missing:
            message = "expected Rerun's Python package, found none; install it: pip install rerun-sdk"
            raise ImportError(message) from missing
        rr.log("body", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True, recording=recording)
        for trigger in self.triggers:
            cloud = self.cloud(trigger)
            rr.set_time("trigger", sequence=trigger, recording=recording)
            if cloud.time_ns is not None:
                rr.set_time("session_time", timestamp=np.datetime64(cloud.time_ns, "ns"), recording=recording)
            chosen = np.linspace(0, len(cloud) - 1, min(points, len(cloud))).astype(np.intp)
            grey = np.rint(255 * cloud.intensity[chosen]).astype(np.uint8)
            shown = rr.Points3D(cloud.xyz_m[chosen], colors=np.repeat(grey[:, None], 3, 1), radii=0.001)
            rr.log("body", shown, recording=recording)
