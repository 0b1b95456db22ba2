# SPDX-License-Identifier: MIT OR Apache-2.0
"""What `fourdbody reconstruct` wrote: clouds and phase maps."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

from . import _native
from .calibration import Calibration
from .clouds import Cloud, PhaseMap, cloud_of


class Result:
    """A directory that `reconstruct` wrote. Clouds are made of the stored phase maps when they are asked for.

    Each file is compared with its name, its session and `summary.json`; a file of something else raises Error (code 4).
    """

    def __init__(self, path: str | os.PathLike):
        self._native = _native.Result(os.fspath(path))
        self.path = Path(path)
        self.triggers: tuple[int, ...] = tuple(self._native.triggers())
        """The triggers that have a cloud, in order."""
        summary = self.path / "summary.json"
        self.summary: dict = json.loads(summary.read_text()) if summary.exists() else {}
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
