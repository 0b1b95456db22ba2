// SPDX-License-Identifier: MIT OR Apache-2.0
//! The formats that points and meshes are exported to.

#[cfg(feature = "e57")]
use super::e57;
use super::shape::Shape;
use super::{glb, pcd, ply, text};
use crate::base::write_whole;
use std::io;
use std::path::Path;

/// A format of files of points; some hold triangles too.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Format {
    /// PLY, binary: the layout of the command line's contract.
    Ply,
    /// PLY as text, for programs that read no binary files.
    PlyAscii,
    /// PCD of the Point Cloud Library, binary.
    Pcd,
    /// XYZ, with or without lines that begin with `#`, and at most so many columns.
    Xyz {
        comments: bool,
        columns: usize,
    },
    /// E57, a scan a camera.
    #[cfg(feature = "e57")]
    E57,
    Glb,
    Obj,
}

impl Format {
    /// XYZ with all that is known.
    pub const XYZ: Self = Self::Xyz { comments: true, columns: usize::MAX };

    /// How files of it are called behind the last dot.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Ply => "ply",
            // Both may lie beside each other.
            Self::PlyAscii => "ascii.ply",
            Self::Pcd => "pcd",
            Self::Xyz { .. } => "xyz",
            #[cfg(feature = "e57")]
            Self::E57 => "e57",
            Self::Glb => "glb",
            Self::Obj => "obj",
        }
    }

    /// Whether it can hold triangles.
    pub fn holds_triangles(self) -> bool {
        matches!(self, Self::Ply | Self::PlyAscii | Self::Glb | Self::Obj)
    }

    /// Whether it can hold the uncertainty of points.
    pub fn holds_sigma(self) -> bool {
        !matches!(self.extension(), "e57" | "obj")
    }

    /// Writes a file, which is never half there. Triangles are an error where the format has no place for them.
    pub fn save(self, path: &Path, shape: &Shape<'_>) -> io::Result<()> {
        if !shape.triangles.is_empty() && !self.holds_triangles() {
            return Err(io::Error::other(format!("{} holds points only, not triangles", self.extension())));
        }
        write_whole(path, |file| match self {
            Self::Ply if shape.triangles.is_empty() && shape.cloud.pixel.len() == shape.cloud.len() => {
                ply::write(file, shape.cloud, shape.comments)
            }
            Self::Ply => text::write_ply_mesh(file, shape),
            Self::PlyAscii => text::write_ply_ascii(file, shape),
            Self::Pcd => pcd::write(file, shape),
            Self::Xyz { comments, columns } => text::write_xyz(file, shape, comments, columns),
            #[cfg(feature = "e57")]
            Self::E57 => e57::write(file, shape),
            Self::Glb => glb::write(file, shape),
            Self::Obj => text::write_obj(file, shape),
        })
    }
}
