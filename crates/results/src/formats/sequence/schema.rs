// SPDX-License-Identifier: MIT OR Apache-2.0
//! Schemas of the messages of a sequence (`FileDescriptorSet`), and the little of protobuf that writes them.
//!
//! Wire format: field number and wire type as a varint, then the value.

/// A protobuf message under construction.
#[derive(Default)]
pub(crate) struct Message(pub(crate) Vec<u8>);

impl Message {
    pub(crate) fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    pub(crate) fn integer(mut self, field: u64, value: u64) -> Self {
        self.varint(field << 3);
        self.varint(value);
        self
    }

    pub(crate) fn fixed32(mut self, field: u64, value: u32) -> Self {
        self.varint(field << 3 | 5);
        self.0.extend_from_slice(&value.to_le_bytes());
        self
    }

    pub(crate) fn double(mut self, field: u64, value: f64) -> Self {
        self.varint(field << 3 | 1);
        self.0.extend_from_slice(&value.to_le_bytes());
        self
    }

    pub(crate) fn bytes(mut self, field: u64, value: &[u8]) -> Self {
        self.varint(field << 3 | 2);
        self.varint(value.len() as u64);
        self.0.extend_from_slice(value);
        self
    }

    pub(crate) fn message(self, field: u64, value: Message) -> Self {
        self.bytes(field, &value.0)
    }
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
pub(crate) fn point_cloud() -> Vec<u8> {
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
        timestamp(),
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

fn timestamp() -> Message {
    let fields: &[Field] = &[("seconds", 1, Kind::Int64, "", false), ("nanos", 2, Kind::Int32, "", false)];
    file("google/protobuf/timestamp.proto", "google.protobuf", &[], vec![kind("Timestamp", fields)])
}

/// A `FileDescriptorProto` of proto3, with its messages.
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

/// A `DescriptorProto` of a message with these fields.
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
