// SPDX-License-Identifier: MIT OR Apache-2.0
//! Sequences of clouds as MCAP, readable by time and by camera without reading all: every message is a chunk of its
//! own, which the file's summary lists with its time and topic.
//!
//! | topic | message | of |
//! |---|---|---|
//! | `/cloud` | `foxglove.PointCloud` | the merged cloud, with the number of its camera at every point |
//! | `/cloud/CAMERA` | `foxglove.PointCloud` | a directional cloud |
//!
//! Points have the fields of PCD files: `x`, `y`, `z`, `intensity`, `normal_x`, `normal_y`, `normal_z`, and where they are
//! known `u`, `v`, `camera` and `sigma`.
//!
//! Existing viewers play `foxglove.PointCloud` in protobuf; its published schema is
//! <https://github.com/foxglove/foxglove-sdk/blob/main/schemas/proto/foxglove/PointCloud.proto>. The schemas are few
//! enough to be encoded here by hand.

mod schema;

use super::shape::{Column, Value};
use crate::data::Cloud;
use crate::record::protobuf::{self, MessageWriter};
use mcap::records::MessageHeader;
use std::collections::BTreeMap;
use std::io::{Seek, Write};

/// Topic of merged clouds; those of the cameras follow behind a slash.
pub const CLOUD_TOPIC: &str = "/cloud";

/// The steps that places may be rounded to, metres: below, floats are as coarse; above, nothing is left of a surface.
pub const STEPS_M: std::ops::RangeInclusive<f64> = 1e-6..=1e-2;

/// What normals are rounded to where places are: an error of at most 0.2 degrees.
const NORMAL_STEP: f32 = 1.0 / 256.0;
/// What intensities are rounded to where places are: a quarter of a grey value.
const INTENSITY_STEP: f32 = 1.0 / 1024.0;

/// Numbers of `foxglove.PackedElementField.NumericType`: unsigned integers of 8 and 16 bits, floats of 32.
const UINT8: u64 = 1;
const UINT16: u64 = 3;
const FLOAT32: u64 = 7;

/// How the clouds of a sequence are rounded and compressed.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Options {
    /// Level of zstd that chunks are compressed with, 1 to 19; 0: they are not.
    pub zstd_level: u32,
    /// Places are rounded to steps of at most this, metres, so that they compress; `None` for the floats themselves.
    pub step_m: Option<f64>,
}

impl Options {
    /// Makes the `foxglove.PointCloud` of a cloud.
    pub fn encode(self, message: &mut Vec<u8>, time_ns: u64, cloud: &Cloud) {
        let columns = Column::of(cloud);
        start_message(message, time_ns, cloud.len(), &columns);
        // Whole steps of a power of two leave the last bytes of a float empty.
        let place_step = self.step_m.map(|step_m| step_m.log2().floor().exp2() as f32);
        let step = |column: &Column| match column.pcd {
            "x" | "y" | "z" => place_step,
            "intensity" => place_step.map(|_| INTENSITY_STEP),
            "normal_x" | "normal_y" | "normal_z" => place_step.map(|_| NORMAL_STEP),
            _ => None,
        };
        let columns: Vec<_> = columns.iter().map(|column| (column, step(column))).collect();
        for i in 0..cloud.len() {
            for (column, step) in &columns {
                match (column.value)(cloud, i) {
                    Value::Float(x) => {
                        let x = step.map_or(x, |step| (x / step).round() * step);
                        message.extend_from_slice(&x.to_le_bytes());
                    }
                    Value::Short(x) => message.extend_from_slice(&x.to_le_bytes()),
                    Value::Byte(x) => message.push(x),
                }
            }
        }
    }
}

/// Writes a sequence, message by message. Whoever exports makes it around a file that is not complete yet; every cloud
/// that was pushed is in the file in order of the calls, and [`Self::finish`] makes the file whole.
pub struct SequenceWriter<W: Write + Seek> {
    writer: mcap::Writer<W>,
    options: Options,
    /// The channel of each topic, and its messages so far.
    channels: BTreeMap<String, (u16, u32)>,
    /// The message under construction: its memory is kept.
    message: Vec<u8>,
}

impl<W: Write + Seek> SequenceWriter<W> {
    /// Starts a file of merged clouds, without compression: noise does not compress.
    pub fn new(out: W) -> Result<Self, mcap::McapError> {
        Self::with(out, Options::default())
    }

    /// Starts a file of clouds that are written with these options.
    pub fn with(out: W, options: Options) -> Result<Self, mcap::McapError> {
        let compression = (options.zstd_level > 0).then_some(mcap::Compression::Zstd);
        let writing = mcap::WriteOptions::new()
            .compression(compression)
            .compression_level(options.zstd_level)
            // The same bytes on every machine.
            .compression_threads(0)
            // `write` ends a chunk behind every message.
            .chunk_size(None)
            .library("fourdbody");
        let writer = writing.create(out)?;
        Ok(Self { writer, options, channels: BTreeMap::new(), message: Vec::new() })
    }

    /// Appends a merged cloud. `time_ns` must not go back.
    pub fn push(&mut self, time_ns: u64, cloud: &Cloud) -> Result<(), mcap::McapError> {
        let mut message = std::mem::take(&mut self.message);
        self.options.encode(&mut message, time_ns, cloud);
        let written = self.write(time_ns, None, &message);
        self.message = message;
        written
    }

    /// Writes an encoded message at its time, on the topic of its camera; `None`: of merged clouds. A topic is
    /// announced when it is needed first.
    pub fn write(
        &mut self,
        time_ns: u64,
        camera: Option<&str>,
        message: &[u8],
    ) -> Result<(), mcap::McapError> {
        let topic = camera.map_or_else(|| CLOUD_TOPIC.to_owned(), |camera| format!("{CLOUD_TOPIC}/{camera}"));
        let (channel_id, sequence) = match self.channels.get(&topic) {
            Some(known) => *known,
            None => {
                let (name, descriptors) = ("foxglove.PointCloud", schema::point_cloud());
                let schema = self.writer.add_schema(name, "protobuf", &descriptors)?;
                (self.writer.add_channel(schema, &topic, "protobuf", &BTreeMap::new())?, 0)
            }
        };
        self.channels.insert(topic, (channel_id, sequence.wrapping_add(1)));
        let header = MessageHeader { channel_id, sequence, log_time: time_ns, publish_time: time_ns };
        self.writer.write_to_known_channel(&header, message)?;
        self.writer.flush()
    }

    /// Completes the file and gives back what it was written to.
    pub fn finish(mut self) -> Result<W, mcap::McapError> {
        self.writer.finish()?;
        Ok(self.writer.into_inner())
    }
}

/// All of a message but its points.
fn start_message(out: &mut Vec<u8>, time_ns: u64, points: usize, columns: &[Column]) {
    let stride: usize = columns.iter().map(Column::bytes).sum();
    let identity = MessageWriter::default()
        .message(1, MessageWriter::default())
        .message(2, MessageWriter::default().double(4, 1.0));
    let timestamp = protobuf::timestamp(MessageWriter::default(), time_ns);
    let mut head = MessageWriter::default()
        .message(1, timestamp)
        .bytes(2, b"world")
        .message(3, identity)
        .fixed32(4, stride as u32);
    let mut offset = 0;
    for column in columns {
        let kind = match column.bytes() {
            1 => UINT8,
            2 => UINT16,
            _ => FLOAT32,
        };
        let field =
            MessageWriter::default().bytes(1, column.pcd.as_bytes()).fixed32(2, offset).varint(3, kind);
        head = head.message(5, field);
        offset += column.bytes() as u32;
    }
    out.clear();
    out.extend(head.bytes_header(6, (points * stride) as u64).into_bytes());
}

#[cfg(test)]
mod tests {
    use super::{Options, SequenceWriter};
    use crate::data::Cloud;
    use std::io::Cursor;

    fn cloud() -> Cloud {
        Cloud {
            position_m: vec![[1.0, 2.0, 3.0]],
            normal: vec![[0.0, 0.0, 1.0]],
            intensity: vec![0.5],
            pixel: vec![[3, 4]],
            camera: vec![6],
            sigma_m: vec![0.25],
        }
    }

    #[test]
    fn a_message_has_the_bytes_of_the_wire_format() {
        let mut writer = SequenceWriter::new(Cursor::new(Vec::new())).expect("memory");
        writer.push(2_000_000_001, &cloud()).expect("memory");
        let bytes = writer.message.clone();
        // timestamp {1: 2, 2: 1}, frame_id "world", pose {1: {}, 2: {4: 1.0}}, point_stride 37.
        let head = [10, 4, 8, 2, 16, 1, 18, 5, b'w', b'o', b'r', b'l', b'd', 26, 13, 10, 0, 18, 9, 33];
        assert_eq!(&bytes[..head.len()], head);
        let stride = [0, 0, 0, 0, 0, 0, 0xf0, 0x3f, 37, 37, 0, 0, 0];
        assert_eq!(&bytes[head.len()..head.len() + stride.len()], stride);
        // The first field: {1: "x", 2: 0, 3: 7}.
        let field = [42, 10, 10, 1, b'x', 21, 0, 0, 0, 0, 24, 7];
        assert_eq!(&bytes[head.len() + stride.len()..][..field.len()], field);
        // {6: 37 bytes}, at whose end are u, v, camera and sigma.
        assert_eq!(bytes[bytes.len() - 39..][..2], [50, 37]);
        assert_eq!(bytes[bytes.len() - 9..], [3, 0, 4, 0, 6, 0, 0, 0x80, 0x3e]);
    }

    #[test]
    fn rounded_places_keep_to_half_a_step_and_have_empty_bytes() {
        let exact = Cloud { position_m: vec![[1.234_567, -0.765_432, 0.1]], ..cloud() };
        let mut message = Vec::new();
        Options { step_m: Some(2e-5), ..Options::default() }.encode(&mut message, 0, &exact);
        let point = &message[message.len() - 37..];
        for (k, x) in exact.position_m[0].into_iter().enumerate() {
            let bytes: [u8; 4] = point[4 * k..4 * k + 4].try_into().expect("four bytes");
            assert!((f32::from_le_bytes(bytes) - x).abs() <= 1e-5 && bytes[0] & 0x3f == 0, "{x}: {bytes:?}");
        }
        assert_eq!(point[32], 6);
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
