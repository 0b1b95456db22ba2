# SPDX-License-Identifier: MIT OR Apache-2.0
"""Photographs of the board to a calibration, and whether a calibration still stands."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable
from typing import Any

from . import _native
from .session import Session

Source = Session | str | os.PathLike[str]
"""A session, its directory, or a directory of images `CAMERA/INDEX.png`."""


def calibrate(
    sessions: Source | Iterable[Source],
    rig: str | os.PathLike[str],
    board: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    report: str | os.PathLike[str] | None = None,
    partial: bool = False,
    upright: Iterable[int] = (),
    level: Iterable[int] = (),
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Calibrates all heads from photographs of the board into the file `out`, as `fourdbody calibrate` does.

    At each position of the board there is one frame in white light, then one with fringes. The world that results is
    right-handed, z up, in metres. Ctrl-C ends it: while photographs are read at once, during the adjustment that follows
    at its end, after some seconds.

    Args:
        sessions: One session, or several that follow each other.
        rig: The rig file; its geometry is where the search starts.
        board: The board file, with the centres as measured.
        out: The calibration file that is written, for `Calibration`.
        report: A directory for a page with residuals, coverage and advice.
        partial: Leave out heads that cannot be calibrated instead of refusing.
        upright: Positions of the board, from 1, in which two of its edges were plumb: they define the vertical.
        level: Positions in which the board lay level: likewise.
        progress: Is called with frames read and their number.

    Returns:
        What `fourdbody calibrate --json` prints: `calibration`, `quality` (residuals in px and mm), `findings`,
        `advice`, `report`, and `unreadable`, the parts of sessions that could not be read.

    Raises:
        Error: A stage failed; the text names what was left out and why. Nothing was written then.
    """
    if isinstance(sessions, (Session, str, os.PathLike)):
        sessions = [sessions]
    return json.loads(_native.calibrate([_path(one) for one in sessions], os.fspath(rig), os.fspath(board), os.fspath(out),
                                        _optional(report), partial, list(upright), list(level), progress))


def calibration_check(
    session: Source,
    calibration: str | os.PathLike[str],
    *,
    frame_sets: int = 8,
    most_mm: float = 0.2,
    corrected: str | os.PathLike[str] | None = None,
    history: str | os.PathLike[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Measures how devices have moved since a calibration, as `fourdbody calibration check` does.

    Any body that fills the volume will do. Turns are about a device's own axes in degrees, shifts along them in mm; those
    of a head are about and along the axes of the world.

    Args:
        session: The session that is looked at.
        calibration: The file of the calibration.
        frame_sets: How many frame sets are looked at, evenly over the session, 1 to 1000.
        most_mm: By how much a device may have moved what it sees of the body, mm.
        corrected: A file for the calibration with these moves; it is written only where cameras agree better with it.
        history: A directory; the result is added to its history, and the plot there is drawn anew.
        progress: Is called with frame sets done and their number, in each of up to five rounds.

    Returns:
        What `fourdbody calibration check --json` prints: `stands` (false where the command ends with code 4), `verdict`,
        `said` (a sentence), `most_mm`, and `drift` with a row for each device. Beside that `unreadable`, the parts of the
        session that could not be read, and `not_corrected`: why `corrected` was not written, or None.

    Raises:
        Error: The session does not show how devices stand, or they have moved too far to be measured (code 4).
    """
    if not 1 <= frame_sets <= 1000:
        raise ValueError(f"expected 1 to 1000 frame sets, found {frame_sets}")
    if not 0 < most_mm < float("inf"):
        raise ValueError(f"expected millimetres above 0, found {most_mm}")
    return json.loads(_native.calibration_check(_path(session), os.fspath(calibration), frame_sets, most_mm,
                                                _optional(corrected), _optional(history), progress))


def _path(source: Source) -> str:
    return source.path if isinstance(source, Session) else os.fspath(source)


def _optional(path: str | os.PathLike[str] | None) -> str | None:
    return None if path is None else os.fspath(path)
