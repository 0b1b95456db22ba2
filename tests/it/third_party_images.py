# SPDX-License-Identifier: MIT OR Apache-2.0
"""Photographs as other programs write them: `third_party_images.py DIR`, a folder per kind, 48 x 32 pixels.

Eight bits are (3 u + 7 v) mod 256, twelve bits (37 u + 11 v) mod 4096: tests/it/images_of_others.rs has the same."""

import struct
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import tifffile
from PIL import Image

v, u = np.mgrid[:32, :48]
eight = ((3 * u + 7 * v) % 256).astype(np.uint8)
twelve = ((37 * u + 11 * v) % 4096).astype(np.uint16)
colour = np.dstack([eight // 2, 255 - eight, eight])  # OpenCV's order: blue, green, red


def place(name):
    path = Path(sys.argv[1]) / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return str(path)


for index, ending in enumerate(["png", "bmp", "tif", "pgm"]):
    cv2.imwrite(place(f"grey/h0_up/{index}.{ending}"), eight)
for index, ending in enumerate(["png", "bmp", "tif"]):
    cv2.imwrite(place(f"grey_as_rgb/h0_up/{index}.{ending}"), cv2.cvtColor(eight, cv2.COLOR_GRAY2BGR))
    cv2.imwrite(place(f"colour/h0_up/{index}.{ending}"), colour)
Image.fromarray(eight).save(place("grey/h0_up/4.tiff"), compression="tiff_lzw")
Image.fromarray(eight).convert("P").save(place("grey_as_rgb/h0_up/3.png"))
cv2.imwrite(place("twelve/h0_up/0.png"), twelve)
cv2.imwrite(place("twelve/h0_up/1.pgm"), twelve)
tifffile.imwrite(place("twelve/h0_up/2.tif"), twelve, compression="zlib")
cv2.imwrite(place("jpeg/h0_up/0.jpg"), eight, [cv2.IMWRITE_JPEG_QUALITY, 100])

# None of them writes four bits of grey: two pixels a byte, and no filter before each row.
packed = ((eight // 16)[:, ::2] << 4) | (eight // 16)[:, 1::2]
parts = [(b"IHDR", struct.pack(">IIBBBBB", 48, 32, 4, 0, 0, 0, 0)),
         (b"IDAT", zlib.compress(b"".join(b"\0" + row.tobytes() for row in packed))), (b"IEND", b"")]
chunks = [struct.pack(">I", len(d)) + kind + d + struct.pack(">I", zlib.crc32(kind + d)) for kind, d in parts]
Path(place("narrow/h0_up/0.png")).write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))

for number, name in [(1, "left"), (3, "left"), (11, "left"), (101, "right"), (103, "right"), (111, "right")]:
    cv2.imwrite(place(f"names/{name}{number:02}.png"), eight + number)
