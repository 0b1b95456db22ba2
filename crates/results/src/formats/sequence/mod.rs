// SPDX-License-Identifier: MIT OR Apache-2.0
//! Sequences of clouds as MCAP, readable by time and by camera without reading all: every message is a chunk of its own,
//! which the file's summary lists with its time and topic.
//!
//! | topic | message | of |
//! |---|---|---|
//! | `/cloud` | `foxglove.PointCloud` | the merged cloud, with the number of its camera at every point |
//! | `/cloud/CAMERA` | `foxglove.PointCloud` | a directional cloud |
//! | `/quantized`, `/quantized/CAMERA` | `fourdbody.QuantizedCloud` ([`quantized`]) | the same, rounded, in a tenth of the bytes |
//!
//! Existing viewers play `foxglove.PointCloud` in protobuf; its published schema is
//! <https://github.com/foxglove/foxglove-sdk/blob/main/schemas/proto/foxglove/PointCloud.proto>. The schemas are few
//! enough to be encoded here by hand.

pub mod quantized;
mod schema;

use super::ply;
use crate::data::Cloud;
use crate::record::protobuf::{self, MessageWriter};
use mcap::records::MessageHeader;
use std::collections::BTreeMap;
use std::io::{Seek, Write};

/// Topic of merged clouds; those of the cameras follow behind a slash.
pub const CLOUD_TOPIC: &str = "/cloud";
/// Topic of quantized merged clouds; those of the cameras follow behind a slash.
pub const QUANTIZED_TOPIC: &str = "/quantized";

/// Bytes of one packed point: x, y, z, intensity, nx, ny, nz (float), camera (uint8).
const STRIDE: usize = 29;

/// Packed fields: name, offset and number of `foxglove.PackedElementField.NumericType`.
const FIELDS: [(&str, u32, u64); 8] = [
    ("x", 0, FLOAT32),
    ("y", 4, FLOAT32),
    ("z", 8, FLOAT32),
    ("intensity", 12, FLOAT32),
    ("normal_x", 16, FLOAT32),
    ("normal_y", 20, FLOAT32),
    ("normal_z", 24, FLOAT32),
    ("camera", 28, UINT8),
];
const UINT8: u64 = 1;
const FLOAT32: u64 = 7;

/// How clouds are written.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Options {
    /// Level of zstd that chunks are compressed with, 1 to 19; 0: they are not.
    pub zstd_level: u32,
    /// The step that places are rounded to, metres; `None` for the floats themselves.
    pub step_m: Option<f64>,
}

impl Options {
    /// Makes the message of a cloud.
    pub fn encode(self, message: &mut Vec<u8>, time_ns: u64, cloud: &Cloud) {
        match self.step_m {
            None => pack(message, time_ns, cloud),
            Some(step_m) => quantized::encode(message, time_ns, cloud, step_m),
        }
    }
}

/// Writes a sequence.
pub struct SequenceWriter<W: Write + Seek> {
    writer: mcap::Writer<W>,
    options: Options,
    channels: BTreeMap<String, u16>,
    /// Messages so far of each channel.
    counts: BTreeMap<u16, u32>,
    /// The message under construction: its memory is kept.
    message: Vec<u8>,
}

impl<W: Write + Seek> SequenceWriter<W> {
    /// Starts a file of merged clouds, without compression: noise does not compress.
    pub fn new(out: W) -> Result<Self, mcap::McapError> {
        let mut writer = Self::with(out, Options::default())?;
        writer.channel(None)?;
        Ok(writer)
    }

    /// Starts a file.
    pub fn with(out: W, options: Options) -> Result<Self, mcap::McapError> {
        let compression = (options.zstd_level > 0).then_some(mcap::Compression::Zstd);
        let writing = mcap::WriteOptions::new()
            .compression(compression)
            .compression_level(options.zstd_level)
            // The same bytes on every machine.
            .compression_threads(0)
            // Chunks end where `write` says: behind every message.
            .chunk_size(None)
            .library("fourdbody");
        let writer = writing.create(out)?;
        let (channels, counts) = (BTreeMap::new(), BTreeMap::new());
        Ok(Self { writer, options, channels, counts, message: Vec::new() })
    }

    /// Appends a cloud of all cameras, or of the one that is named. `time_ns` must not go back.
    pub fn push_of(
        &mut self,
        time_ns: u64,
        camera: Option<&str>,
        cloud: &Cloud,
    ) -> Result<(), mcap::McapError> {
        let mut message = std::mem::take(&mut self.message);
        self.options.encode(&mut message, time_ns, cloud);
        let written = self.write(time_ns, camera, &message);
        self.message = message;
        written
    }

    /// Appends a merged cloud. `time_ns` must not go back.
    pub fn push(&mut self, time_ns: u64, cloud: &Cloud) -> Result<(), mcap::McapError> {
        self.push_of(time_ns, None, cloud)
    }

    /// Appends the merged cloud of a PLY file as it is, without rounding: its points are packed nearly as those of a message
    /// are.
    pub fn push_ply(&mut self, time_ns: u64, path: &std::path::Path) -> Result<(), String> {
        let mut message = std::mem::take(&mut self.message);
        start_message(&mut message, time_ns, 0);
        let mut started = false;
        ply::stream(path, |points, bytes, stride| {
            if !std::mem::replace(&mut started, true) {
                start_message(&mut message, time_ns, points);
            }
            let from = message.len();
            message.resize(from + bytes.len() / stride * STRIDE, 0);
            for (to, point) in message[from..].chunks_exact_mut(STRIDE).zip(bytes.chunks_exact(stride)) {
                to[..STRIDE - 1].copy_from_slice(&point[..STRIDE - 1]);
                // After the source pixel; without a camera there may be other properties.
                to[STRIDE - 1] = if (stride - ply::POINT_BYTES) % 4 == 1 {
                    point[ply::POINT_BYTES]
                } else {
                    crate::data::NO_CAMERA
                };
            }
            Ok(())
        })
        .map_err(|e| e.to_string())?;
        let written = self.write(time_ns, None, &message).map_err(|e| e.to_string());
        self.message = message;
        written
    }

    /// The channel of the topic, which is announced when it is needed first.
    fn channel(&mut self, camera: Option<&str>) -> Result<u16, mcap::McapError> {
        let (base, name, schema) = match self.options.step_m {
            None => (CLOUD_TOPIC, "foxglove.PointCloud", schema::point_cloud as fn() -> Vec<u8>),
            Some(_) => {
                (QUANTIZED_TOPIC, "fourdbody.QuantizedCloud", schema::quantized_cloud as fn() -> Vec<u8>)
            }
        };
        let topic = camera.map_or_else(|| base.to_owned(), |camera| format!("{base}/{camera}"));
        if let Some(channel) = self.channels.get(&topic) {
            return Ok(*channel);
        }
        let schema = self.writer.add_schema(name, "protobuf", &schema())?;
        let channel = self.writer.add_channel(schema, &topic, "protobuf", &BTreeMap::new())?;
        self.channels.insert(topic, channel);
        Ok(channel)
    }

    /// Writes an encoded message at its time, on the topic of its camera; `None`: of merged clouds.
    pub fn write(
        &mut self,
        time_ns: u64,
        camera: Option<&str>,
        message: &[u8],
    ) -> Result<(), mcap::McapError> {
        let channel_id = self.channel(camera)?;
        let count = self.counts.entry(channel_id).or_default();
        let header = MessageHeader { channel_id, sequence: *count, log_time: time_ns, publish_time: time_ns };
        *count = count.wrapping_add(1);
        self.writer.write_to_known_channel(&header, message)?;
        self.writer.flush()
    }

    /// Completes the file and gives back what it was written to.
    pub fn finish(mut self) -> Result<W, mcap::McapError> {
        self.writer.finish()?;
        Ok(self.writer.into_inner())
    }
}

/// A cloud as `foxglove.PointCloud`.
fn pack(message: &mut Vec<u8>, time_ns: u64, cloud: &Cloud) {
    start_message(message, time_ns, cloud.len());
    let points = cloud.position_m.iter().zip(&cloud.normal).zip(&cloud.intensity);
    for (i, ((position, normal), intensity)) in points.enumerate() {
        for x in position.iter().chain([intensity]).chain(normal) {
            message.extend_from_slice(&x.to_le_bytes());
        }
        message.push(cloud.camera.get(i).copied().unwrap_or(crate::data::NO_CAMERA));
    }
}

fn timestamp(time_ns: u64) -> MessageWriter {
    protobuf::timestamp(MessageWriter::default(), time_ns)
}

/// All of a message but its points.
fn start_message(out: &mut Vec<u8>, time_ns: u64, points: usize) {
    let identity = MessageWriter::default()
        .message(1, MessageWriter::default())
        .message(2, MessageWriter::default().double(4, 1.0));
    let mut head = MessageWriter::default()
        .message(1, timestamp(time_ns))
        .bytes(2, b"world")
        .message(3, identity)
        .fixed32(4, STRIDE as u32);
    for (name, offset, kind) in FIELDS {
        let field = MessageWriter::default().bytes(1, name.as_bytes()).fixed32(2, offset).varint(3, kind);
        head = head.message(5, field);
    }
    out.clear();
    out.extend(head.bytes_header(6, (points * STRIDE) as u64).into_bytes());
}

#[cfg(test)]
mod tests {
    use super::SequenceWriter;
    use crate::data::Cloud;
    use std::io::Cursor;

    fn cloud() -> Cloud {
        Cloud {
            position_m: vec![[1.0, 2.0, 3.0]],
            normal: vec![[0.0, 0.0, 1.0]],
            intensity: vec![0.5],
            pixel: vec![[3, 4]],
            camera: vec![6],
            sigma_m: Vec::new(),
        }
    }

    #[test]
    fn a_message_has_the_bytes_of_the_wire_format() {
        let mut writer = SequenceWriter::new(Cursor::new(Vec::new())).expect("memory");
        writer.push(2_000_000_001, &cloud()).expect("memory");
        let bytes = writer.message.clone();
        // The same from a file.
        let file = tempfile::NamedTempFile::new().expect("a temporary file");
        crate::formats::ply::save(file.path(), &cloud(), &[]).expect("writable");
        writer.push_ply(2_000_000_001, file.path()).expect("intact");
        assert_eq!(writer.message, bytes);
        // timestamp {1: 2, 2: 1}, frame_id "world", pose {1: {}, 2: {4: 1.0}}, point_stride 29.
        let head = [10, 4, 8, 2, 16, 1, 18, 5, b'w', b'o', b'r', b'l', b'd', 26, 13, 10, 0, 18, 9, 33];
        assert_eq!(&bytes[..head.len()], head);
        let stride = [0, 0, 0, 0, 0, 0, 0xf0, 0x3f, 37, 29, 0, 0, 0];
        assert_eq!(&bytes[head.len()..head.len() + stride.len()], stride);
        // The first field: {1: "x", 2: 0, 3: 7}.
        let field = [42, 10, 10, 1, b'x', 21, 0, 0, 0, 0, 24, 7];
        assert_eq!(&bytes[head.len() + stride.len()..][..field.len()], field);
        assert_eq!(bytes[bytes.len() - 31..][..2], [50, 29]);
        assert_eq!(bytes.last(), Some(&6));
    }

    #[test]
    fn a_sequence_reads_back() {
        let mut writer = SequenceWriter::new(Cursor::new(Vec::new())).expect("memory");
        for i in 0..3 {
            writer.push(i * 8_333_333, &cloud()).expect("memory");
        }
        let bytes = writer.finish().expect("memory").into_inner();
        let messages: Vec<_> =
            mcap::MessageStream::new(&bytes).expect("intact").map(|m| m.expect("intact")).collect();
        assert_eq!(messages.len(), 3);
        assert_eq!(messages[2].log_time, 16_666_666);
        let schema = messages[0].channel.schema.as_ref().expect("a schema");
        assert_eq!((schema.name.as_str(), schema.encoding.as_str()), ("foxglove.PointCloud", "protobuf"));
    }
}
