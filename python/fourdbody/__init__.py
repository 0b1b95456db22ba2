# SPDX-License-Identifier: MIT OR Apache-2.0
"""Recordings, clouds and calibrations of the fourdbody 4D body scanner as NumPy arrays.

Lengths are metres, angles and phases radians, times nanoseconds, unless a name says otherwise. The world is
right-handed, z up. A pixel is (u, v): u is the column, integers are pixel centres.

Examples:
    >>> import fourdbody as fb
    >>> session = fb.Session("sessions/walk-01")
    >>> image = session.frame(12, "h0_up")             # uint8, rows x columns, or a Gap with its cause
    >>> result = fb.reconstruct(session, fb.Calibration("calibration.json"), "walk-01", triggers=range(12))
    >>> cloud = result.cloud(11)                       # cloud.xyz_m, cloud.normal, cloud.camera, ...
"""

from .calibrating import calibrate, calibration_check
from .calibration import Calibration
from .clouds import Cloud, PhaseMap
from .errors import Error
from .reconstruction import FrameSet, Reconstructor, reconstruct, reconstruct_images
from .result import Result
from .session import Gap, Session

__all__ = [
    "Calibration",
    "Cloud",
    "Error",
    "FrameSet",
    "Gap",
    "PhaseMap",
    "Reconstructor",
    "Result",
    "Session",
    "calibrate",
    "calibration_check",
    "reconstruct",
    "reconstruct_images",
]
