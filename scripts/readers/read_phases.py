# SPDX-License-Identifier: MIT OR Apache-2.0
"""The pixels of a phase map, by docs/reference/phase-maps.md: `read_phases.py h0_up_000000.phase`."""
import io
import json
import sys
import zlib
import numpy as np

def varint(body):
    byte = body.read(1)[0]
    return byte if byte < 128 else (byte & 127) | varint(body) << 7

def unzigzag(x):
    return (x >> 1) ^ -(x & 1)

def unpack(body, count):
    """Signed numbers that are packed in blocks of 64."""
    numbers = np.zeros((-(-count // 64), 64), np.int64)
    for block in numbers:
        width = body.read(1)[0]
        bits = np.unpackbits(np.frombuffer(body.read(8 * width), "u1"), bitorder="little").reshape(64, width)
        block[:] = bits.astype(np.int64) @ (1 << np.arange(width))
    return unzigzag(numbers.ravel()[:count])

def read(path):
    """The header, and u, v, phase (rad), light (DN), sigma (rad; None where it is not known) of each pixel."""
    data = open(path, "rb").read()
    length, size, stated = (int.from_bytes(data[at:][:4], "little") for at in (8, 12, -4))
    if data[:8] != b"4dphase1" or (len(data), stated) != (20 + length + size, zlib.crc32(data[:-4])):
        raise ValueError(f"{path}: no phase map of version 1, or a damaged one")
    header, body = json.loads(data[16:16 + length]), io.BytesIO(data[16 + length:-4])
    runs, row, end = [], 0, 0
    for _ in range(header["runs"]):
        rows, gap, count = varint(body), varint(body), varint(body)
        row, first = row + rows, gap + (0 if rows else end)
        end = first + count
        runs.append((row, first, count))
    starts, first, step = [], 0, 0
    for _, _, count in runs:
        first += unzigzag(varint(body))
        step += unzigzag(varint(body)) if count > 1 else 0
        starts.append((first, step))
    bends, steps = iter(unpack(body, sum(max(count - 2, 0) for _, _, count in runs)).tolist()), [np.zeros(0, np.int64)]
    for (first, step), (_, _, count) in zip(starts, runs):
        slopes = np.cumsum([step] + [next(bends) for _ in range(count - 2)])[:count - 1]
        steps.append(first + np.concatenate([[0], np.cumsum(slopes)]))
    light = np.cumsum(unpack(body, header["pixels"])) & 0xffff
    code = np.cumsum(unpack(body, header["pixels"])) & 0xff if header["doubt"] else None
    fit = [row < header["frame"][1] and first + count <= header["frame"][0] for row, first, count in runs]
    if body.read() or not all(fit) or sum(count for _, _, count in runs) != header["pixels"]:
        raise ValueError(f"{path}: runs or bytes that do not fit its header")
    u = np.array([at for _, first, count in runs for at in range(first, first + count)], int)
    v = np.array([row for row, _, count in runs for _ in range(count)], int)
    phase = np.concatenate(steps).astype(np.int32) / 8192 * 2 * np.pi
    sigma = None if code is None else (0x38d1b717 + (code << 19)).astype(np.uint32).view(np.float32)
    return header, u, v, phase, light / 4, sigma

if __name__ == "__main__":
    header, *pixels = read(sys.argv[1])
    print(header["statement"], f"{len(pixels[0])} pixels; first u, v, rad, DN:", *(part[:1] for part in pixels[:4]))
