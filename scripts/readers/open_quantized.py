# SPDX-License-Identifier: MIT OR Apache-2.0
"""A quantized sequence (`export --to mcap --quantize`) in NumPy: `clouds(path)` yields time (ns) and a dict of columns."""
import sys
import numpy as np
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

def clouds(path, topic="/quantized"):
    reader = make_reader(open(path, "rb"), decoder_factories=[DecoderFactory()])
    for _, _, message, cloud in reader.iter_decoded_messages([topic]):
        planes = np.frombuffer(cloud.data, np.uint8).reshape(len(cloud.columns), 4, cloud.points)
        zigzag = (planes.astype(np.uint32) << np.array([[0], [8], [16], [24]], np.uint32)).sum(1, dtype=np.uint32)
        steps = np.cumsum((zigzag >> 1).astype(np.int64) ^ -(zigzag & 1).astype(np.int64), 1)
        out = {column.name: row * column.step for column, row in zip(cloud.columns, steps)}
        a, b = out.pop("normal_a"), out.pop("normal_b")
        up = 1 - abs(a) - abs(b)
        folded = lambda a, b: np.where(up < 0, (1 - abs(b)) * np.where(a < 0, -1, 1), a)
        normal = np.stack([folded(a, b), folded(b, a), up])
        out["normal_x"], out["normal_y"], out["normal_z"] = normal / np.linalg.norm(normal, axis=0)
        yield message.log_time, out

if __name__ == "__main__":
    for time_ns, points in clouds(*sys.argv[1:]):
        print(time_ns, len(points["x"]), "points")
