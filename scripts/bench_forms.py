# SPDX-License-Identifier: MIT OR Apache-2.0
"""Bytes a point and times of ways to store a merged cloud: chunk compressions, byte planes, rounding to steps.

    tests/.venv/bin/python scripts/bench_forms.py OUT/merged/000000.ply

`packed` is the data of a foxglove.PointCloud, 29 bytes a point; `planes` the same with the first bytes of all points
first, then the second ones; `steps` that of a fourdbody.QuantizedCloud. Least of three runs, one thread; the packages lz4
and zstandard, which come with `mcap`.
"""

import sys
import time

import lz4.frame
import numpy as np
import zstandard
from plyfile import PlyData

RUNS = 3


def packed(vertex):
    names = ["x", "y", "z", "intensity", "nx", "ny", "nz", "camera"]
    kind = np.dtype([(name, "u1" if name == "camera" else "<f4") for name in names])
    points = np.empty(len(vertex.data), kind)
    for name in names:
        points[name] = vertex[name]
    return points.tobytes()


def planes(column):
    difference = np.diff(column.astype(np.int32), prepend=np.int32(0))
    zigzag = ((difference << 1) ^ (difference >> 31)).astype("<u4")
    return zigzag.view(np.uint8).reshape(-1, 4).T.tobytes()


def steps(vertex, step_m):
    n = np.stack([vertex["nx"], vertex["ny"], vertex["nz"]]).astype(float)
    a, b, up = n / abs(n).sum(0)
    folded = lambda a, b: np.where(up < 0, (1 - abs(b)) * np.where(a < 0, -1, 1), a)
    columns = [np.round(vertex[axis].astype(float) / step_m) for axis in "xyz"]
    columns += [np.round(vertex["intensity"].astype(float) * 1020)]
    columns += [np.round(folded(a, b) * 511), np.round(folded(b, a) * 511)]
    columns += [vertex["u"], vertex["v"], vertex["camera"]]
    return b"".join(planes(column) for column in columns)


def least(work):
    times = []
    for _ in range(RUNS):
        began = time.perf_counter()
        result = work()
        times.append(time.perf_counter() - began)
    return result, 1e3 * min(times)


vertex = PlyData.read(sys.argv[1])["vertex"]
points = len(vertex.data)
raw = packed(vertex)
split = np.frombuffer(raw, np.uint8).reshape(points, -1).T.tobytes()
forms = [("packed", raw), ("planes", split)]
forms += [(f"steps of {step} mm", steps(vertex, step / 1e3)) for step in (0.05, 0.02, 0.01)]
codecs = [("lz4", lz4.frame.compress, lz4.frame.decompress)]
for level in (1, 3, 9):
    compressor, decompressor = zstandard.ZstdCompressor(level), zstandard.ZstdDecompressor()
    codecs.append((f"zstd {level}", compressor.compress, decompressor.decompress))
print(f"{points} points\n\n| form | compression | bytes a point | pack ms | unpack ms |\n|---|---|---|---|---|")
for name, data in forms:
    print(f"| {name} | none | {len(data) / points:.2f} | | |")
    for codec, pack, unpack in codecs:
        small, packing = least(lambda: pack(data))
        back, unpacking = least(lambda: unpack(small))
        assert back == data
        print(f"| {name} | {codec} | {len(small) / points:.2f} | {packing:.0f} | {unpacking:.0f} |")
