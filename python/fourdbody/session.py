# SPDX-License-Identifier: MIT OR Apache-2.0
"""Recorded sessions: frames, times, verdicts."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import _native


@dataclass(frozen=True)
class Gap:
    """A frame that is missing."""

    cause: str
    """Why, a word of the recording's gap records, for instance `missing_packets`."""
    trigger: int
    """The trigger index of the frame."""
    camera: str
    """Name of the camera that has none."""

    def __bool__(self) -> bool:
        return False


class Session:
    """A session, the directory with the recordings of all its nodes; one recording, or one segment, will do, too.

    Opening reads indexes; frames are read, and their checksums checked, when they are asked for. Nothing is ever written.
    """

    def __init__(self, path: str | os.PathLike[str]):
        self._native = _native.Session(os.fspath(path))
        self.path = os.fspath(path)
        """Where it lies."""
        facts = self._native.facts()
        self.id: str = facts["id"]
        """The identity that all its recordings state."""
        self.name: str | None = facts["name"]
        """Its name, where it has one."""
        self.nodes: tuple[str, ...] = tuple(facts["nodes"])
        """Names of the nodes whose recordings are there."""
        self.cameras: tuple[str, ...] = tuple(facts["cameras"])
        """Names of all cameras, in the order of the rig."""
        self.range = range(*facts["triggers"])
        """The trigger indexes of the session."""
        self.time_base: str | None = facts["time_base"]
        """The clock that `triggers["time_ns"]` is of, in words."""
        self.unreadable: tuple[str, ...] = tuple(facts["unreadable"])
        """Recordings of which nothing can be read, a sentence each: the session is not whole."""

    def __repr__(self) -> str:
        return f"<Session {self.name}: {len(self.range)} triggers of {len(self.cameras)} cameras>"

    def __len__(self) -> int:
        return len(self.range)

    @property
    def triggers(self) -> NDArray[np.void]:
        """A structured array with a row for each trigger. Times are int64, ns; -1 where one is not known.

        `index`; `time_ns` since 1970 on the clock of `time_base`, as clouds have it; `hsu_time_ns` since the HSU was
        switched on; `host_time_ns_NODE`, when the node heard of the trigger, its clock, UTC; `time_code`, text.
        """
        return _table(self._native.triggers())

    def outcomes(self, camera: str) -> NDArray[np.void]:
        """A structured array with a row for each trigger of one camera. -1 where a number is not known.

        `index`; `outcome`: `frame`, the cause of a gap, or `damaged`; `block_id`; `camera_time_ns`, the begin of the
        exposure on the camera's clock; `host_time_ns`, when the frame arrived, the node's clock, UTC.
        """
        self._check(camera)
        return _table(self._native.outcomes(camera))

    def frame(self, trigger: int, camera: str) -> NDArray[np.uint8] | Gap:
        """The pixels of a frame, uint8, rows x columns; or a Gap (which is false) with its cause.

        Raises Error with code 4 where the recording is damaged there.
        """
        self._check(camera)
        if trigger not in self.range:
            raise IndexError(f"expected a trigger from {self.range.start} to {self.range.stop - 1}, found {trigger}")
        found = self._native.frame(trigger, camera)
        return Gap(found, trigger, camera) if isinstance(found, str) else found

    def frames(
        self, cameras: Iterable[str] | None = None, triggers: Iterable[int] | None = None
    ) -> Iterator[tuple[int, str, NDArray[np.uint8] | Gap]]:
        """Trigger, camera and frame, trigger by trigger; each is read when it is its turn."""
        cameras = self.cameras if cameras is None else tuple(cameras)
        for trigger in self.range if triggers is None else triggers:
            for camera in cameras:
                yield trigger, camera, self.frame(trigger, camera)

    @property
    def rig(self) -> str:
        """The rig file that the session was recorded with, TOML."""
        return self._native.rig()

    def events(self) -> list[dict[str, Any]]:
        """What happened on the nodes, in order of time: `kind`, `node`, `host_time_ns`, `message`, and where it names
        them `camera` and `trigger`."""
        return json.loads(self._native.events())

    def verify(self) -> dict[str, Any]:
        """What `fourdbody verify --json` prints: every checksum, and which trigger each frame belongs to, anew."""
        return json.loads(self._native.verify())

    @property
    def verdict(self) -> dict[str, dict[str, Any] | None]:
        """The verdict that each node has stored: outcomes by camera; None where it did not finish its recording.

        `verify` counts it anew and compares.
        """
        return json.loads(self._native.verdicts())

    def _check(self, camera: str) -> None:
        if camera not in self.cameras:
            raise KeyError(f"expected one of {', '.join(self.cameras)}, found {camera!r}")


def _table(columns: dict[str, Any]) -> NDArray[np.void]:
    """A structured array of columns."""
    arrays = {name: np.array(values, "U") if isinstance(values, list) else values for name, values in columns.items()}
    table = np.empty(len(arrays["index"]), [(name, array.dtype) for name, array in arrays.items()])
    for name, array in arrays.items():
        table[name] = array
    return table
