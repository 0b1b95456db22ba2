// SPDX-License-Identifier: MIT OR Apache-2.0
//! Schemas of the messages of a sequence: `FileDescriptorSet`s, which an MCAP file carries.

use crate::record::protobuf::{Kind, MessageWriter, describe, file, file_set};

const TIMESTAMP: &str = "google/protobuf/timestamp.proto";

/// The `FileDescriptorSet` of `foxglove.PointCloud` with all it refers to.
pub(crate) fn point_cloud() -> Vec<u8> {
    let vector =
        describe("Vector3", &[("x", 1, Kind::Double), ("y", 2, Kind::Double), ("z", 3, Kind::Double)]);
    let quaternion = describe(
        "Quaternion",
        &[("x", 1, Kind::Double), ("y", 2, Kind::Double), ("z", 3, Kind::Double), ("w", 4, Kind::Double)],
    );
    let pose = describe(
        "Pose",
        &[
            ("position", 1, Kind::Message(".foxglove.Vector3")),
            ("orientation", 2, Kind::Message(".foxglove.Quaternion")),
        ],
    );
    let element = describe(
        "PackedElementField",
        &[
            ("name", 1, Kind::Text),
            ("offset", 2, Kind::Fixed32),
            ("type", 3, Kind::Enum(".foxglove.PackedElementField.NumericType")),
        ],
    );
    let numeric = ["UNKNOWN", "UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64"];
    let numeric = (0..).zip(numeric).fold(
        MessageWriter::default().bytes(1, b"NumericType"),
        |message, (number, name)| {
            message.message(2, MessageWriter::default().bytes(1, name.as_bytes()).varint(2, number))
        },
    );
    let cloud = describe(
        "PointCloud",
        &[
            ("timestamp", 1, Kind::Message(".google.protobuf.Timestamp")),
            ("frame_id", 2, Kind::Text),
            ("pose", 3, Kind::Message(".foxglove.Pose")),
            ("point_stride", 4, Kind::Fixed32),
            ("fields", 5, Kind::Repeated(".foxglove.PackedElementField")),
            ("data", 6, Kind::Bytes),
        ],
    );
    let of_pose = ["foxglove/Quaternion.proto", "foxglove/Vector3.proto"];
    let of_cloud = ["foxglove/PackedElementField.proto", "foxglove/Pose.proto", TIMESTAMP];
    let foxglove = |path: &str, imports: &[&str], message| file(path, "foxglove", imports, vec![message]);
    file_set([
        foxglove("foxglove/Vector3.proto", &[], vector),
        foxglove("foxglove/Quaternion.proto", &[], quaternion),
        foxglove("foxglove/Pose.proto", &of_pose, pose),
        foxglove("foxglove/PackedElementField.proto", &[], element.message(4, numeric)),
        foxglove("foxglove/PointCloud.proto", &of_cloud, cloud),
    ])
}
