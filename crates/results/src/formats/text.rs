// SPDX-License-Identifier: MIT OR Apache-2.0
//! Formats of text, and PLY with triangles: ASCII PLY, XYZ and OBJ. Numbers are the shortest that read back the same.
//!
//! XYZ has no standard: a line a point, columns separated by spaces, `x y z nx ny nz intensity u v camera`, and lines that
//! begin with `#`. Readers that know three or six columns find the place and the normal.
//!
//! OBJ: `v x y z r g b` with the intensity as a grey (a widespread extension), `vn`, and `p` or `f` elements.

use super::shape::{Column, Shape, Value, one_line, pack};
use std::io::{self, BufWriter, Write};

/// Bytes gathered before they are written.
const BUFFER_BYTES: usize = 1 << 18;

/// Writes PLY as text.
pub(crate) fn write_ply_ascii(out: impl Write, shape: &Shape<'_>) -> io::Result<()> {
    let mut out = BufWriter::with_capacity(BUFFER_BYTES, out);
    let columns = Column::of(shape.cloud);
    out.write_all(ply_header("ascii", shape, &columns).as_bytes())?;
    (0..shape.cloud.len()).try_for_each(|i| row(&mut out, shape, &columns, i))?;
    for [a, b, c] in shape.triangles {
        writeln!(out, "3 {a} {b} {c}")?;
    }
    out.flush()
}

/// Writes binary PLY with triangles. (Without triangles see [`super::ply`].)
pub(crate) fn write_ply_mesh(out: impl Write, shape: &Shape<'_>) -> io::Result<()> {
    let mut out = BufWriter::with_capacity(BUFFER_BYTES, out);
    let columns = Column::of(shape.cloud);
    out.write_all(ply_header("binary_little_endian", shape, &columns).as_bytes())?;
    let mut bytes = Vec::new();
    for i in 0..shape.cloud.len() {
        bytes.clear();
        pack(shape.cloud, &columns, i, &mut bytes);
        out.write_all(&bytes)?;
    }
    for triangle in shape.triangles {
        out.write_all(&[3])?;
        triangle.iter().try_for_each(|corner| out.write_all(&corner.to_le_bytes()))?;
    }
    out.flush()
}

fn ply_header(format: &str, shape: &Shape<'_>, columns: &[Column]) -> String {
    let mut header = format!("ply\nformat {format} 1.0\n");
    for comment in shape.comments {
        header += &format!("comment {}\n", one_line(comment));
    }
    header += &format!("element vertex {}\n", shape.cloud.len());
    for column in columns {
        let (kind, name) = match column {
            Column::X => ("float", "x"),
            Column::Y => ("float", "y"),
            Column::Z => ("float", "z"),
            Column::Intensity => ("float", "intensity"),
            Column::NormalX => ("float", "nx"),
            Column::NormalY => ("float", "ny"),
            Column::NormalZ => ("float", "nz"),
            Column::U => ("ushort", "u"),
            Column::V => ("ushort", "v"),
            Column::Camera => ("uchar", "camera"),
            Column::Sigma => ("float", "sigma"),
        };
        header += &format!("property {kind} {name}\n");
    }
    if !shape.triangles.is_empty() {
        header +=
            &format!("element face {}\nproperty list uchar uint vertex_indices\n", shape.triangles.len());
    }
    header + "end_header\n"
}

fn row(out: &mut impl Write, shape: &Shape<'_>, columns: &[Column], i: usize) -> io::Result<()> {
    for (k, column) in columns.iter().enumerate() {
        let space = if k == 0 { "" } else { " " };
        write!(out, "{space}{}", column.value(shape.cloud, i))?;
    }
    writeln!(out)
}

/// Writes XYZ.
pub(crate) fn write_xyz(out: impl Write, shape: &Shape<'_>) -> io::Result<()> {
    let mut out = BufWriter::with_capacity(BUFFER_BYTES, out);
    let mut columns = Column::of(shape.cloud);
    // The normal directly behind the place, where readers of six columns expect it.
    columns.remove(3);
    columns.insert(6, Column::Intensity);
    for comment in shape.comments {
        writeln!(out, "# {}", one_line(comment))?;
    }
    let names: Vec<String> = columns.iter().map(|column| xyz_name(*column).to_owned()).collect();
    writeln!(out, "# {}", names.join(" "))?;
    (0..shape.cloud.len()).try_for_each(|i| row(&mut out, shape, &columns, i))?;
    out.flush()
}

fn xyz_name(column: Column) -> &'static str {
    match column {
        Column::X => "x_m",
        Column::Y => "y_m",
        Column::Z => "z_m",
        Column::Intensity => "intensity",
        Column::NormalX => "nx",
        Column::NormalY => "ny",
        Column::NormalZ => "nz",
        Column::U => "u",
        Column::V => "v",
        Column::Camera => "camera",
        Column::Sigma => "sigma_m",
    }
}

/// Writes OBJ.
pub(crate) fn write_obj(out: impl Write, shape: &Shape<'_>) -> io::Result<()> {
    let mut out = BufWriter::with_capacity(BUFFER_BYTES, out);
    for comment in shape.comments {
        writeln!(out, "# {}", one_line(comment))?;
    }
    for (position, intensity) in shape.cloud.position_m.iter().zip(&shape.cloud.intensity) {
        let [x, y, z] = position.map(Value::Float);
        writeln!(out, "v {x} {y} {z} {intensity} {intensity} {intensity}")?;
    }
    for [x, y, z] in &shape.cloud.normal {
        writeln!(out, "vn {x} {y} {z}")?;
    }
    if shape.triangles.is_empty() {
        // Elements of one point each: a reader that joins the points of an element draws none twice.
        (1..=shape.cloud.len()).try_for_each(|i| writeln!(out, "p {i}"))?;
    }
    for triangle in shape.triangles {
        let [a, b, c] = triangle.map(|corner| u64::from(corner) + 1);
        writeln!(out, "f {a}//{a} {b}//{b} {c}//{c}")?;
    }
    out.flush()
}
