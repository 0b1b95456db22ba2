# SPDX-License-Identifier: MIT OR Apache-2.0
"""A sequence of clouds in NumPy: `clouds("sequence.mcap")` yields time (ns) and one structured array a cloud."""
import sys
import numpy as np
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

TYPES = ["", "u1", "i1", "<u2", "<i2", "<u4", "<i4", "<f4", "<f8"]  # foxglove.PackedElementField.NumericType

def clouds(path, topic="/cloud", start_ns=None, end_ns=None):
    reader = make_reader(open(path, "rb"), decoder_factories=[DecoderFactory()])
    for _, _, message, cloud in reader.iter_decoded_messages([topic], start_ns, end_ns):
        names, kinds, places = zip(*((field.name, TYPES[field.type], field.offset) for field in cloud.fields))
        kind = np.dtype(dict(names=names, formats=kinds, offsets=places, itemsize=cloud.point_stride))
        yield message.log_time, np.frombuffer(cloud.data, kind)

if __name__ == "__main__":
    for time_ns, points in clouds(*sys.argv[1:]):
        print(time_ns, len(points), "points, mean height", points["z"].mean(dtype=float) if len(points) else None)
