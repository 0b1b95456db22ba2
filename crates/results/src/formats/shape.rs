// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a file of points or triangles is made of, and its points as a table: the same columns for every format.

use crate::data::{Cloud, NO_CAMERA};

/// Points, and triangles between them where there are any, with what is known about them.
#[derive(Debug, Clone, Copy)]
pub struct Shape<'a> {
    /// The points. Source pixels may be missing altogether (an empty array).
    pub cloud: &'a Cloud,
    /// Corners of each triangle, counter-clockwise as seen from outside: places in `cloud`.
    pub triangles: &'a [[u32; 3]],
    /// Lines that say where it comes from; kept wherever a format has a place for them.
    pub comments: &'a [String],
    /// Numbers and names of the cameras.
    pub cameras: &'a [(u8, String)],
}

/// A column of the table of points.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Column {
    X,
    Y,
    Z,
    Intensity,
    NormalX,
    NormalY,
    NormalZ,
    U,
    V,
    Camera,
    Sigma,
}

/// An entry of the table.
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
        let mut columns = vec![Self::X, Self::Y, Self::Z, Self::Intensity];
        columns.extend([Self::NormalX, Self::NormalY, Self::NormalZ]);
        if cloud.pixel.len() == cloud.len() {
            columns.extend([Self::U, Self::V]);
        }
        if cloud.is_merged() {
            columns.push(Self::Camera);
        }
        if !cloud.sigma_m.is_empty() {
            columns.push(Self::Sigma);
        }
        columns
    }

    /// Its bytes.
    pub(crate) fn bytes(self) -> usize {
        match self {
            Self::U | Self::V => 2,
            Self::Camera => 1,
            _ => 4,
        }
    }

    /// The entry of point `i`.
    pub(crate) fn value(self, cloud: &Cloud, i: usize) -> Value {
        match self {
            Self::X => Value::Float(cloud.position_m[i][0]),
            Self::Y => Value::Float(cloud.position_m[i][1]),
            Self::Z => Value::Float(cloud.position_m[i][2]),
            Self::Intensity => Value::Float(cloud.intensity[i]),
            Self::NormalX => Value::Float(cloud.normal[i][0]),
            Self::NormalY => Value::Float(cloud.normal[i][1]),
            Self::NormalZ => Value::Float(cloud.normal[i][2]),
            Self::U => Value::Short(cloud.pixel[i][0]),
            Self::V => Value::Short(cloud.pixel[i][1]),
            Self::Camera => Value::Byte(cloud.camera.get(i).copied().unwrap_or(NO_CAMERA)),
            Self::Sigma => Value::Float(cloud.sigma_m[i]),
        }
    }
}

/// Appends the little-endian bytes of point `i`.
pub(crate) fn pack(cloud: &Cloud, columns: &[Column], i: usize, out: &mut Vec<u8>) {
    for column in columns {
        match column.value(cloud, i) {
            Value::Float(x) => out.extend_from_slice(&x.to_le_bytes()),
            Value::Short(x) => out.extend_from_slice(&x.to_le_bytes()),
            Value::Byte(x) => out.push(x),
        }
    }
}

/// A comment as one line.
pub(crate) fn one_line(comment: &str) -> String {
    comment.replace(['\n', '\r'], " ")
}
