# SPDX-License-Identifier: MIT OR Apache-2.0
"""A recording, every record checked, by docs/reference/recordings.md: `read_recording.py SESSION/node-a`."""
import hashlib
import json
import sys
import zlib
from pathlib import Path
import numpy as np
from mcap.records import Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

def check(is_right, *wrong):
    if not is_right:
        raise ValueError(" ".join(map(str, wrong)))

def pixels_of(message, frame):
    """The pixels of a frame as an array of rows, after both checksums."""
    covered = len(message) - len(frame.data) - (len(frame.data).bit_length() + 6) // 7 - 1 - 6
    check(message[covered:covered + 2] == b"\xf5\x3e", "field 1006 is not the one before the pixels")
    sums = zlib.crc32(message[:covered]), zlib.crc32(frame.data)
    check(sums == (frame.envelope_crc32, frame.pixels_crc32), "a frame is damaged")
    check(frame.encoding == "mono8" and frame.step == frame.width, "no grey image without gaps")
    return np.frombuffer(frame.data, np.uint8).reshape(frame.height, frame.width)

def records(recording):
    """Topic or name, fields, and pixels of frames: each record, in the order of the files."""
    numbers, counted, own = {None}, None, None
    for path in sorted(Path(recording).glob("segment-*.mcap"), key=lambda path: int(path.stem[8:])):
        schemas, channels, decoders = {}, {}, DecoderFactory()
        for record in StreamReader(open(path, "rb"), validate_crcs=True).records:
            pixels = None
            if isinstance(record, (Schema, Channel)):
                (schemas if isinstance(record, Schema) else channels)[record.id] = record
            elif isinstance(record, Metadata):
                name, fields = record.name, dict(record.metadata)
                stated = int(fields.pop("crc32"))
                text = "".join(f"{key}\0{value}\0" for key, value in sorted(fields.items()))
                check(zlib.crc32(text.encode()) == stated, path, name, "is damaged")
                if name == "fourdbody.header":
                    of = [fields[key] for key in ("format", "version", "session_id", "node")]
                    check(of[:2] == ["fourdbody-recording", "2"] and own in (None, of), path, "is of", of, "not", own)
                    own, mark = of, hashlib.sha256(of[2].encode()).hexdigest()[:16]
                counted, found = fields.get("records", counted), fields.get("session_mark", mark)
            elif isinstance(record, Message):
                name, schema = channels[record.channel_id].topic, schemas[channels[record.channel_id].schema_id]
                if schema.encoding == "protobuf":
                    fields = decoders.decoder_for("protobuf", schema)(record.data)
                    pixels, found = pixels_of(record.data, fields), f"{fields.session_mark:016x}"
                else:
                    fields = json.loads(record.data)
                    found, _ = fields["session"], numbers.add(fields.get("n"))
            if isinstance(record, (Metadata, Message)):
                check(found == mark, path, "has a record of another session:", name)
                yield name, fields, pixels
    check(counted and numbers == {None, *range(int(counted))}, recording, "lacks its verdict or small records")

if __name__ == "__main__":
    for name, fields, pixels in records(sys.argv[1]):
        print(name, fields if pixels is None else (fields.trigger_index, fields.host_time_ns, pixels.mean()))
