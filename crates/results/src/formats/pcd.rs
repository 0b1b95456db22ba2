// SPDX-License-Identifier: MIT OR Apache-2.0
//! PCD, the format of the Point Cloud Library, version 0.7, binary. Normals are `normal_x normal_y normal_z` as there.

use super::shape::{Column, Shape, one_line, write_points};
use std::io::{self, BufWriter, Write};

/// Writes all points of a shape as PCD.
pub(crate) fn write(out: impl Write, shape: &Shape<'_>) -> io::Result<()> {
    let mut out = BufWriter::with_capacity(1 << 18, out);
    let columns = Column::of(shape.cloud);
    let list = |of: &dyn Fn(&Column) -> String| columns.iter().map(of).collect::<Vec<_>>().join(" ");
    writeln!(out, "# .PCD v0.7 - Point Cloud Data file format")?;
    for comment in shape.comments {
        writeln!(out, "# {}", one_line(comment))?;
    }
    writeln!(out, "VERSION 0.7")?;
    writeln!(out, "FIELDS {}", list(&|column| column.pcd.to_owned()))?;
    writeln!(out, "SIZE {}", list(&|column| column.bytes().to_string()))?;
    writeln!(out, "TYPE {}", list(&|column| if column.bytes() == 4 { "F" } else { "U" }.to_owned()))?;
    writeln!(out, "COUNT {}", list(&|_| "1".to_owned()))?;
    let points = shape.cloud.len();
    // The viewpoint is a pose of the sensor: the points are in the world already.
    writeln!(out, "WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA binary")?;
    write_points(&mut out, shape.cloud, &columns)?;
    out.flush()
}
