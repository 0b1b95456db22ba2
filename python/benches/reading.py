# SPDX-License-Identifier: MIT OR Apache-2.0
"""How fast a session is read, beside its disk: python python/benches/reading.py SESSION [TRIGGERS]

The same files are read as they are, then as frames with their checksums; the system's cache is emptied before each.
"""

import os
import statistics
import sys
import time
from pathlib import Path

import fourdbody as fb

ROUNDS = 5


def forget(paths):
    """Has the system forget what it keeps of the files."""
    for path in paths:
        with open(path, "rb") as file:
            os.fsync(file.fileno())
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def plain(paths):
    """Bytes that are read, 8 MiB at a time."""
    total, buffer = 0, bytearray(8 << 20)
    for path in paths:
        with open(path, "rb", buffering=0) as file:
            while count := file.readinto(buffer):
                total += count
    return total


def frames(path, triggers):
    """Bytes of frames that are read."""
    session = fb.Session(path)
    count = min(triggers, len(session))
    return count, sum(frame.nbytes for _, _, frame in session.frames(triggers=session.range[:count]) if len(frame))


path, triggers = Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1000
paths = sorted(path.rglob("*.mcap"))
shares = []
for _ in range(ROUNDS):
    forget(paths)
    began = time.perf_counter()
    disk = plain(paths) / (time.perf_counter() - began)
    forget(paths)
    began = time.perf_counter()
    count, size = frames(path, triggers)
    read = size / (time.perf_counter() - began)
    shares.append(read / disk)
    print(f"{count} triggers: disk {disk / 1e6:.0f} MB/s, frames {read / 1e6:.0f} MB/s, {shares[-1]:.0%} of it")
print(f"median: {statistics.median(shares):.0%} of the disk's rate")
