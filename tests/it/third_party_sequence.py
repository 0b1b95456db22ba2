# SPDX-License-Identifier: MIT OR Apache-2.0
"""Reads a sequence of merged clouds with the `mcap` package, every checksum on, and prints what it found.

Argument: a sequence.mcap. With `mcap_protobuf` installed, clouds are decoded by the schema in the file.
"""

import json
import math
import struct
import sys

from mcap.reader import SeekingReader

try:
    from mcap_protobuf.decoder import DecoderFactory
except ImportError:
    DecoderFactory = None

FLOAT32 = 7
UINT16 = 3
UINT8 = 1
FIELDS = [(name, 4 * i, FLOAT32) for i, name in enumerate(["x", "y", "z", "intensity", "normal_x", "normal_y", "normal_z"])]
FIELDS += [("u", 28, UINT16), ("v", 30, UINT16), ("camera", 32, UINT8), ("sigma", 33, FLOAT32)]
POINT = struct.Struct("<7f2HBf")
assert POINT.size == 37

path = sys.argv[1]
found = {"messages": 0, "points": None, "last": None}
with open(path, "rb") as file:
    for schema, channel, _ in SeekingReader(file, validate_crcs=True).iter_messages():
        assert (schema.name, channel.topic) == ("foxglove.PointCloud", "/cloud"), (schema.name, channel.topic)
        found["messages"] += 1
if DecoderFactory is not None:
    found["points"] = []
    with open(path, "rb") as file:
        reader = SeekingReader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, _, message, cloud in reader.iter_decoded_messages(topics=["/cloud"]):
            assert cloud.timestamp.seconds * 10**9 + cloud.timestamp.nanos == message.log_time
            assert [(f.name, f.offset, f.type) for f in cloud.fields] == FIELDS, cloud.fields
            assert cloud.point_stride == POINT.size and len(cloud.data) % POINT.size == 0
            for point in POINT.iter_unpack(cloud.data):
                assert all(math.isfinite(value) for value in point), point
                assert abs(math.hypot(*point[4:7]) - 1) < 1e-3 and 0 <= point[3] <= 1, point
            found["points"].append(len(cloud.data) // POINT.size)
            if cloud.data:
                found["last"] = [round(value, 6) for value in POINT.unpack(cloud.data[-POINT.size :])]
print(json.dumps(found))
