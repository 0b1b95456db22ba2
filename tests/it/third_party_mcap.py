# SPDX-License-Identifier: MIT OR Apache-2.0
"""Reads recordings with the `mcap` package, every checksum on, and prints what it found as JSON.

Arguments: segments of one recording. With `mcap_protobuf` installed, frames are decoded by the schema that
the recording carries.
"""

import json
import sys
import zlib
from collections import Counter

from mcap.reader import NonSeekingReader, SeekingReader

try:
    from mcap_protobuf.decoder import DecoderFactory
except ImportError:
    DecoderFactory = None

counts = Counter()
metadata = []
decoded = None if DecoderFactory is None else 0
for path in sys.argv[1:]:
    with open(path, "rb") as file:
        reader = SeekingReader(file, validate_crcs=True)
        seeking = Counter(channel.topic for _, channel, _ in reader.iter_messages())
        statistics = reader.get_summary().statistics.message_count
        metadata += [record.name for record in reader.iter_metadata()]
    with open(path, "rb") as file:
        streaming = Counter(channel.topic for _, channel, _ in NonSeekingReader(file, validate_crcs=True).iter_messages())
    if seeking != streaming or sum(seeking.values()) != statistics:
        sys.exit(f"{path}: {seeking} by the index, {streaming} by streaming, {statistics} by the statistics")
    counts += seeking
    if DecoderFactory is not None:
        with open(path, "rb") as file:
            reader = SeekingReader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
            images = [topic for topic in seeking if topic.endswith("/image")]
            for _, _, message, frame in reader.iter_decoded_messages(topics=images):
                assert frame.encoding == "mono8" and frame.step == frame.width
                assert len(frame.data) == frame.width * frame.height
                assert zlib.crc32(frame.data) == frame.pixels_crc32, "checksum of the pixels"
                assert frame.trigger_index == message.sequence
                assert frame.timestamp.seconds * 10**9 + frame.timestamp.nanos == frame.host_time_ns == message.log_time
                decoded += 1
print(json.dumps({"counts": counts, "metadata": metadata, "decoded": decoded}))
