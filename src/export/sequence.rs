//! Sequences of merged clouds as MCAP: `foxglove.PointCloud` messages in protobuf, so that existing viewers
//! play them.
//!
//! The message and its schema (a `FileDescriptorSet`) are few enough to be encoded here by hand, after the
//! protobuf wire format: field number and wire type as a varint, then the value. The published schema is
//! <https://github.com/foxglove/foxglove-sdk/blob/main/schemas/proto/foxglove/PointCloud.proto>.

use super::cloud::Cloud;
use super::ply;
use mcap::records::MessageHeader;
use std::collections::BTreeMap;
use std::io::{Seek, Write};

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

/// Writes a sequence.
pub struct SequenceWriter<W: Write + Seek> {
    writer: mcap::Writer<W>,
    channel: u16,
    count: u32,
    /// The message under construction: its memory is kept.
    message: Vec<u8>,
}

impl<W: Write + Seek> SequenceWriter<W> {
    /// Starts a file, without compression: noise does not compress.
    pub fn new(out: W) -> Result<Self, mcap::McapError> {
        let options = mcap::WriteOptions::new().compression(None).library("fourdbody");
        let mut writer = options.create(out)?;
        let schema = writer.add_schema("foxglove.PointCloud", "protobuf", &schema())?;
        let channel = writer.add_channel(schema, "/cloud", "protobuf", &BTreeMap::new())?;
        Ok(Self { writer, channel, count: 0, message: Vec::new() })
    }

    /// Appends a cloud. `time_ns` must not go back.
    pub fn push(&mut self, time_ns: u64, cloud: &Cloud) -> Result<(), mcap::McapError> {
        start_message(&mut self.message, time_ns, cloud.len());
        let points = cloud.position_m.iter().zip(&cloud.normal).zip(&cloud.intensity);
        for (i, ((position, normal), intensity)) in points.enumerate() {
            for x in position.iter().chain([intensity]).chain(normal) {
                self.message.extend_from_slice(&x.to_le_bytes());
            }
            self.message.push(cloud.camera.get(i).copied().unwrap_or(super::NO_CAMERA));
        }
        self.write(time_ns)
    }

    /// Appends the cloud of a PLY file, whose points are packed nearly as those of a message are.
    pub fn push_ply(&mut self, time_ns: u64, path: &std::path::Path) -> Result<(), String> {
        let message = &mut self.message;
        start_message(message, time_ns, 0);
        let mut started = false;
        ply::stream(path, |points, bytes, stride| {
            if !std::mem::replace(&mut started, true) {
                start_message(message, time_ns, points);
            }
            let from = message.len();
            message.resize(from + bytes.len() / stride * STRIDE, 0);
            for (to, point) in message[from..].chunks_exact_mut(STRIDE).zip(bytes.chunks_exact(stride)) {
                to[..STRIDE - 1].copy_from_slice(&point[..STRIDE - 1]);
                // After the source pixel; without a camera there may be other properties.
                to[STRIDE - 1] = if (stride - ply::POINT_BYTES) % 4 == 1 {
                    point[ply::POINT_BYTES]
                } else {
                    super::NO_CAMERA
                };
            }
            Ok(())
        })
        .map_err(|e| e.to_string())?;
        self.write(time_ns).map_err(|e| e.to_string())
    }

    fn write(&mut self, time_ns: u64) -> Result<(), mcap::McapError> {
        let header = MessageHeader {
            channel_id: self.channel,
            sequence: self.count,
            log_time: time_ns,
            publish_time: time_ns,
        };
        self.count = self.count.wrapping_add(1);
        self.writer.write_to_known_channel(&header, &self.message)
    }

    /// Completes the file and gives back what it was written to.
    pub fn finish(mut self) -> Result<W, mcap::McapError> {
        self.writer.finish()?;
        Ok(self.writer.into_inner())
    }
}

/// A protobuf message under construction.
#[derive(Default)]
struct Message(Vec<u8>);

impl Message {
    fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    fn integer(mut self, field: u64, value: u64) -> Self {
        self.varint(field << 3);
        self.varint(value);
        self
    }

    fn fixed32(mut self, field: u64, value: u32) -> Self {
        self.varint(field << 3 | 5);
        self.0.extend_from_slice(&value.to_le_bytes());
        self
    }

    fn double(mut self, field: u64, value: f64) -> Self {
        self.varint(field << 3 | 1);
        self.0.extend_from_slice(&value.to_le_bytes());
        self
    }

    fn bytes(mut self, field: u64, value: &[u8]) -> Self {
        self.varint(field << 3 | 2);
        self.varint(value.len() as u64);
        self.0.extend_from_slice(value);
        self
    }

    fn message(self, field: u64, value: Message) -> Self {
        self.bytes(field, &value.0)
    }
}

/// All of a message but its points.
fn start_message(out: &mut Vec<u8>, time_ns: u64, points: usize) {
    let time = Message::default().integer(1, time_ns / 1_000_000_000).integer(2, time_ns % 1_000_000_000);
    let identity =
        Message::default().message(1, Message::default()).message(2, Message::default().double(4, 1.0));
    let mut head =
        Message::default().message(1, time).bytes(2, b"world").message(3, identity).fixed32(4, STRIDE as u32);
    for (name, offset, kind) in FIELDS {
        let field = Message::default().bytes(1, name.as_bytes()).fixed32(2, offset).integer(3, kind);
        head = head.message(5, field);
    }
    head.varint(6 << 3 | 2);
    head.varint((points * STRIDE) as u64);
    out.clear();
    out.extend_from_slice(&head.0);
}

/// Kinds of fields, as `google.protobuf.FieldDescriptorProto.Type` numbers them.
#[derive(Clone, Copy)]
enum Kind {
    Double = 1,
    Int64 = 3,
    Int32 = 5,
    Fixed32 = 7,
    Text = 9,
    Message = 11,
    Bytes = 12,
    Enum = 14,
}

/// One field of a schema: name, number, kind, type name, repeated.
type Field = (&'static str, u64, Kind, &'static str, bool);

/// The `FileDescriptorSet` of `foxglove.PointCloud` with all it refers to.
fn schema() -> Vec<u8> {
    let timestamp: &[Field] = &[("seconds", 1, Kind::Int64, "", false), ("nanos", 2, Kind::Int32, "", false)];
    let vector: &[Field] = &[
        ("x", 1, Kind::Double, "", false),
        ("y", 2, Kind::Double, "", false),
        ("z", 3, Kind::Double, "", false),
    ];
    let quaternion: &[Field] = &[
        ("x", 1, Kind::Double, "", false),
        ("y", 2, Kind::Double, "", false),
        ("z", 3, Kind::Double, "", false),
        ("w", 4, Kind::Double, "", false),
    ];
    let pose: &[Field] = &[
        ("position", 1, Kind::Message, ".foxglove.Vector3", false),
        ("orientation", 2, Kind::Message, ".foxglove.Quaternion", false),
    ];
    let element: &[Field] = &[
        ("name", 1, Kind::Text, "", false),
        ("offset", 2, Kind::Fixed32, "", false),
        ("type", 3, Kind::Enum, ".foxglove.PackedElementField.NumericType", false),
    ];
    let cloud: &[Field] = &[
        ("timestamp", 1, Kind::Message, ".google.protobuf.Timestamp", false),
        ("frame_id", 2, Kind::Text, "", false),
        ("pose", 3, Kind::Message, ".foxglove.Pose", false),
        ("point_stride", 4, Kind::Fixed32, "", false),
        ("fields", 5, Kind::Message, ".foxglove.PackedElementField", true),
        ("data", 6, Kind::Bytes, "", false),
    ];
    let numeric = ["UNKNOWN", "UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64"];
    let numeric = numeric.iter().enumerate().fold(
        Message::default().bytes(1, b"NumericType"),
        |message, (number, name)| {
            let value = Message::default().bytes(1, name.as_bytes()).integer(2, number as u64);
            message.message(2, value)
        },
    );
    let files = [
        file("google/protobuf/timestamp.proto", "google.protobuf", &[], vec![kind("Timestamp", timestamp)]),
        file("foxglove/Vector3.proto", "foxglove", &[], vec![kind("Vector3", vector)]),
        file("foxglove/Quaternion.proto", "foxglove", &[], vec![kind("Quaternion", quaternion)]),
        file(
            "foxglove/Pose.proto",
            "foxglove",
            &["foxglove/Quaternion.proto", "foxglove/Vector3.proto"],
            vec![kind("Pose", pose)],
        ),
        file(
            "foxglove/PackedElementField.proto",
            "foxglove",
            &[],
            vec![kind("PackedElementField", element).message(4, numeric)],
        ),
        file(
            "foxglove/PointCloud.proto",
            "foxglove",
            &["foxglove/PackedElementField.proto", "foxglove/Pose.proto", "google/protobuf/timestamp.proto"],
            vec![kind("PointCloud", cloud)],
        ),
    ];
    files.into_iter().fold(Message::default(), |set, file| set.message(1, file)).0
}

/// A `FileDescriptorProto`.
fn file(name: &str, package: &str, dependencies: &[&str], messages: Vec<Message>) -> Message {
    let mut out = Message::default().bytes(1, name.as_bytes()).bytes(2, package.as_bytes());
    for dependency in dependencies {
        out = out.bytes(3, dependency.as_bytes());
    }
    for message in messages {
        out = out.message(4, message);
    }
    out.bytes(12, b"proto3")
}

/// A `DescriptorProto`.
fn kind(name: &str, fields: &[Field]) -> Message {
    let mut out = Message::default().bytes(1, name.as_bytes());
    for &(name, number, kind, type_name, repeated) in fields {
        // Label: 1 optional, 3 repeated.
        let label = if repeated { 3 } else { 1 };
        let mut field = Message::default()
            .bytes(1, name.as_bytes())
            .integer(3, number)
            .integer(4, label)
            .integer(5, kind as u64);
        if !type_name.is_empty() {
            field = field.bytes(6, type_name.as_bytes());
        }
        out = out.message(2, field);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::SequenceWriter;
    use crate::export::Cloud;
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
        crate::export::ply::save(file.path(), &cloud(), &[]).expect("writable");
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
