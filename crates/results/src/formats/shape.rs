// SPDX-License-Identifier: MIT OR Apache-2.0
//! Points and triangles with what files state of them, and the points as a table: the same columns for every format.

use crate::data::{Cloud, NO_CAMERA};
use std::io::{self, Write};

/// Points, and triangles between them where there are any, with what is known about them.
#[derive(Debug, Clone, Copy)]
pub struct Shape<'a> {
    /// The points. Source pixels may be missing altogether (an empty array).
    pub cloud: &'a Cloud,
    /// Corners of each triangle, counter-clockwise as seen from outside: places in `cloud`.
    pub triangles: &'a [[u32; 3]],
    /// Lines that state where it comes from; kept wherever a format has a place for them.
    pub comments: &'a [String],
    /// Numbers and names of the cameras.
    pub cameras: &'a [(u8, String)],
}

/// A column of the table of points.
pub(crate) struct Column {
    /// Its type and its name in a PLY header.
    pub(crate) ply: (&'static str, &'static str),
    /// Its name in XYZ files, which has the unit.
    pub(crate) xyz: &'static str,
    /// Its name in the Point Cloud Library.
    pub(crate) pcd: &'static str,
    /// The entry of a point.
    pub(crate) value: fn(&Cloud, usize) -> Value,
}

const fn column(
    ply: (&'static str, &'static str),
    xyz: &'static str,
    pcd: &'static str,
    value: fn(&Cloud, usize) -> Value,
) -> Column {
    Column { ply, xyz, pcd, value }
}

/// The coordinates of a point.
const PLACE: [Column; 3] = [
    column(("float", "x"), "x_m", "x", |cloud, i| Value::Float(cloud.position_m[i][0])),
    column(("float", "y"), "y_m", "y", |cloud, i| Value::Float(cloud.position_m[i][1])),
    column(("float", "z"), "z_m", "z", |cloud, i| Value::Float(cloud.position_m[i][2])),
];
pub(crate) const INTENSITY: Column =
    column(("float", "intensity"), "intensity", "intensity", |cloud, i| Value::Float(cloud.intensity[i]));
const NORMAL: [Column; 3] = [
    column(("float", "nx"), "nx", "normal_x", |cloud, i| Value::Float(cloud.normal[i][0])),
    column(("float", "ny"), "ny", "normal_y", |cloud, i| Value::Float(cloud.normal[i][1])),
    column(("float", "nz"), "nz", "normal_z", |cloud, i| Value::Float(cloud.normal[i][2])),
];
const PIXEL: [Column; 2] = [
    column(("ushort", "u"), "u", "u", |cloud, i| Value::Short(cloud.pixel[i][0])),
    column(("ushort", "v"), "v", "v", |cloud, i| Value::Short(cloud.pixel[i][1])),
];
const CAMERA: Column = column(("uchar", "camera"), "camera", "camera", |cloud, i| {
    Value::Byte(cloud.camera.get(i).copied().unwrap_or(NO_CAMERA))
});
const SIGMA: Column =
    column(("float", "sigma"), "sigma_m", "sigma", |cloud, i| Value::Float(cloud.sigma_m[i]));

/// An entry of the table of points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Value {
    Float(f32),
    Short(u16),
    Byte(u8),
}

impl std::fmt::Display for Value {
    /// The shortest text that reads back as the same number.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Float(x) => x.fmt(f),
            Self::Short(x) => x.fmt(f),
            Self::Byte(x) => x.fmt(f),
        }
    }
}

impl Column {
    /// The columns that a cloud has, in the order of the PLY files.
    pub(crate) fn of(cloud: &Cloud) -> Vec<Self> {
        let mut columns = Vec::from(PLACE);
        columns.push(INTENSITY);
        columns.extend(NORMAL);
        if cloud.pixel.len() == cloud.len() {
            columns.extend(PIXEL);
        }
        columns.extend(cloud.is_merged().then_some(CAMERA));
        columns.extend((!cloud.sigma_m.is_empty()).then_some(SIGMA));
        columns
    }

    /// The bytes of its entries.
    pub(crate) fn bytes(&self) -> usize {
        match self.ply.0 {
            "uchar" => 1,
            "ushort" => 2,
            _ => 4,
        }
    }
}

/// Writes the little-endian bytes of all points, one after the other.
pub(crate) fn write_points(out: &mut impl Write, cloud: &Cloud, columns: &[Column]) -> io::Result<()> {
    for i in 0..cloud.len() {
        for column in columns {
            match (column.value)(cloud, i) {
                Value::Float(x) => out.write_all(&x.to_le_bytes())?,
                Value::Short(x) => out.write_all(&x.to_le_bytes())?,
                Value::Byte(x) => out.write_all(&[x])?,
            }
        }
    }
    Ok(())
}

/// A comment as one line.
pub(crate) fn one_line(comment: &str) -> String {
    comment.replace(['\n', '\r'], " ")
}
