// SPDX-License-Identifier: MIT OR Apache-2.0
//! Formats of text, and PLY with triangles: ASCII PLY, XYZ and OBJ. Numbers are the shortest that read back the same.
//!
//! XYZ has no standard: a line a point, columns separated by spaces, `x y z nx ny nz intensity u v camera`, and lines
//! that begin with `#`. Some readers know only three or six columns, or no `#`: both can be left out.
//!
//! OBJ: `v x y z r g b` with the intensity as a grey (a widespread extension), `vn`, and `p` or `f` elements.

use super::shape::{Column, INTENSITY, Shape, Value, one_line, write_points};
use std::io::{self, BufWriter, Write};

/// Bytes gathered before they are written.
const BUFFER_BYTES: usize = 1 << 18;

/// Writes points and triangles as PLY of text.
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
    write_points(&mut out, shape.cloud, &columns)?;
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
    for Column { ply: (kind, name), .. } in columns {
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
        write!(out, "{space}{}", (column.value)(shape.cloud, i))?;
    }
    writeln!(out)
}

/// Writes all points as lines of XYZ of at most so many columns, with or without lines that begin with `#`.
pub(crate) fn write_xyz(out: impl Write, shape: &Shape<'_>, comments: bool, most: usize) -> io::Result<()> {
    let mut out = BufWriter::with_capacity(BUFFER_BYTES, out);
    let mut columns = Column::of(shape.cloud);
    // The normal directly behind the place, where readers of six columns expect it.
    columns.remove(3);
    columns.insert(6, INTENSITY);
    columns.truncate(most);
    if comments {
        shape.comments.iter().try_for_each(|comment| writeln!(out, "# {}", one_line(comment)))?;
        let names: Vec<&str> = columns.iter().map(|column| column.xyz).collect();
        writeln!(out, "# {}", names.join(" "))?;
    }
    (0..shape.cloud.len()).try_for_each(|i| row(&mut out, shape, &columns, i))?;
    out.flush()
}

/// Writes points or triangles as OBJ.
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
        // Elements of one point each: a reader that joins the points of an element then draws no lines.
        (1..=shape.cloud.len()).try_for_each(|i| writeln!(out, "p {i}"))?;
    }
    for triangle in shape.triangles {
        let [a, b, c] = triangle.map(|corner| u64::from(corner) + 1);
        writeln!(out, "f {a}//{a} {b}//{b} {c}//{c}")?;
    }
    out.flush()
}
