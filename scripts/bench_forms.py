# SPDX-License-Identifier: MIT OR Apache-2.0
"""Bytes a point and times of ways to store a merged cloud: chunk compressions, byte planes, rounding to steps.

    tests/.venv/bin/python scripts/bench_forms.py OUT/merged/000000.ply

`packed` is the data of a foxglove.PointCloud, 29 bytes a point; `planes` the same with the first bytes of all points
first, then the second ones; `rounded` what `export --quantize` writes. Least of three runs, one thread; the packages lz4
and zstandard, which come with `mcap`.
"""

import sys
import time

import lz4.frame
import numpy as np
import zstandard
from plyfile import PlyData

RUNS = 3


def packed(vertex, step_m=None):
    names = ["x", "y", "z", "intensity", "nx", "ny", "nz"]
    points = np.empty(len(vertex.data), np.dtype([(name, "<f4") for name in names] + [("camera", "u1")]))
    for name in names:
        points[name] = vertex[name]
        if step_m is not None:
            step = 2.0 ** np.floor(np.log2(step_m)) if name in "xyz" else 1 / 1024 if name == "intensity" else 1 / 256
            points[name] = np.round(points[name] / np.float32(step)) * np.float32(step)
    points["camera"] = vertex["camera"]
    return points.tobytes()


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
forms += [(f"rounded to {step} mm", packed(vertex, step / 1e3)) for step in (0.05, 0.02, 0.01)]
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
