// SPDX-License-Identifier: MIT OR Apache-2.0
//! E57 (ASTM E2807): a scan a camera, in the world frame, with normals in the registered extension `nor`
//! (<http://www.libe57.org/E57_NOR_surface_normals.txt>) and the source pixel as row and column index. Every point states
//! that it is valid: by default pye57 reads no scan without that.
//!
//! Names that the format wants to be unique are made of the content's description, not of chance: the same cloud gives
//! the same bytes.

use super::shape::{Shape, one_line};
use e57::{E57Writer, Extension, Record, RecordDataType, RecordName, RecordValue};
use sha2::{Digest, Sha256};
use std::fs::File;
use std::io;

/// The state of a point whose coordinates are all measured.
const VALID: RecordValue = RecordValue::Integer(0);

const NORMALS: (&str, &str) = ("nor", "http://www.libe57.org/E57_NOR_surface_normals.txt");

/// Writes E57; the file must be open for reading too.
pub(crate) fn write(file: &mut File, shape: &Shape<'_>) -> io::Result<()> {
    write_scans(file, shape).map_err(io::Error::other)
}

fn write_scans(file: &mut File, shape: &Shape<'_>) -> e57::Result<()> {
    let cloud = shape.cloud;
    let mut writer = E57Writer::new(file, &guid(shape.comments, "file"))?;
    writer.register_extension(Extension { namespace: NORMALS.0.to_owned(), url: NORMALS.1.to_owned() })?;
    let cameras: Vec<Option<u8>> = if cloud.is_merged() {
        (0..=u8::MAX).filter(|number| cloud.camera.contains(number)).map(Some).collect()
    } else {
        vec![None]
    };
    let pixels = cloud.pixel.len() == cloud.len();
    for camera in cameras {
        let name = camera.map(|number| {
            let known = shape.cameras.iter().find(|(known, _)| *known == number);
            known.map_or_else(|| format!("camera {number}"), |(_, name)| name.clone())
        });
        let place = name.clone().unwrap_or_default();
        let mut scan = writer.add_pointcloud(&guid(shape.comments, &place), prototype(pixels))?;
        scan.set_name(name);
        let about: Vec<String> = shape.comments.iter().map(|comment| one_line(comment)).collect();
        scan.set_description(Some(about.join("; ")));
        for i in (0..cloud.len()).filter(|&i| camera.is_none_or(|number| cloud.camera[i] == number)) {
            let floats = cloud.position_m[i].iter().chain([&cloud.intensity[i]]).chain(&cloud.normal[i]);
            let mut values: Vec<RecordValue> = floats.map(|x| RecordValue::Single(*x)).collect();
            values.push(VALID);
            if pixels {
                let [u, v] = cloud.pixel[i];
                values.extend([v, u].map(|x| RecordValue::Integer(x.into())));
            }
            scan.add_point(values)?;
        }
        scan.finalize()?;
    }
    writer.finalize()
}

fn prototype(pixels: bool) -> Vec<Record> {
    let single = |name, min, max| Record { name, data_type: RecordDataType::Single { min, max } };
    let normal =
        |axis: &str| RecordName::Unknown { namespace: NORMALS.0.to_owned(), name: format!("normal{axis}") };
    let mut records = vec![
        single(RecordName::CartesianX, None, None),
        single(RecordName::CartesianY, None, None),
        single(RecordName::CartesianZ, None, None),
        single(RecordName::Intensity, Some(0.0), Some(1.0)),
    ];
    records.extend(["X", "Y", "Z"].map(|axis| single(normal(axis), Some(-1.0), Some(1.0))));
    let states = RecordDataType::Integer { min: 0, max: 2 };
    records.push(Record { name: RecordName::CartesianInvalidState, data_type: states });
    if pixels {
        let index = RecordDataType::Integer { min: 0, max: u16::MAX.into() };
        records.push(Record { name: RecordName::RowIndex, data_type: index.clone() });
        records.push(Record { name: RecordName::ColumnIndex, data_type: index });
    }
    records
}

/// A name in the form of a UUID (version 8: made of a hash) for what the comments and `place` describe.
fn guid(comments: &[String], place: &str) -> String {
    let digest = Sha256::digest(format!("{}\n{place}", comments.join("\n")));
    let hex: String = digest.iter().take(16).map(|byte| format!("{byte:02x}")).collect();
    format!("{{{}-{}-8{}-8{}-{}}}", &hex[..8], &hex[8..12], &hex[13..16], &hex[17..20], &hex[20..32])
}
