// SPDX-License-Identifier: MIT OR Apache-2.0
//! Mesh files: reads OBJ (vertices and faces) and PLY (ascii or binary little-endian), writes binary PLY.

use super::mesh::Mesh;
use fourdbody::formats::ply::header_lines;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// Why a mesh file could not be used.
#[derive(Debug, thiserror::Error)]
#[error(
    "{path}: {reason}; expected a triangle or polygon mesh as OBJ, or as PLY (ascii or binary little-endian)"
)]
pub struct MeshError {
    path: PathBuf,
    reason: String,
}

/// Reads one mesh; lengths in metres, z up. Normals that the file lacks are computed.
pub fn read(path: &Path) -> Result<Mesh, MeshError> {
    let fail = |reason: String| MeshError { path: path.to_owned(), reason };
    let bytes = std::fs::read(path).map_err(|e| fail(format!("cannot be read: {e}")))?;
    let mut mesh = match path.extension().and_then(|e| e.to_str()) {
        Some("obj") => parse_obj(&String::from_utf8_lossy(&bytes)),
        Some("ply") => parse_ply(&bytes),
        other => Err(format!("has the extension {other:?}")),
    }
    .map_err(fail)?;
    let count = mesh.positions.len();
    if mesh.triangles.is_empty() {
        return Err(fail("holds no faces".to_owned()));
    }
    if let Some(wrong) = mesh.triangles.iter().flatten().find(|&&v| v as usize >= count) {
        return Err(fail(format!("a face names vertex {wrong}, but there are {count}")));
    }
    if mesh.positions.iter().flatten().any(|x| !x.is_finite()) {
        return Err(fail("a vertex is not finite".to_owned()));
    }
    mesh.albedo = vec![1.0; count];
    mesh.compute_normals();
    Ok(mesh)
}

/// The mesh files that `path` names: itself, or the OBJ and PLY files in it by name.
pub fn sequence(path: &Path) -> io::Result<Vec<PathBuf>> {
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let mut files = Vec::new();
    for entry in std::fs::read_dir(path)? {
        let file = entry?.path();
        if matches!(file.extension().and_then(|e| e.to_str()), Some("obj" | "ply")) {
            files.push(file);
        }
    }
    files.sort();
    if files.is_empty() {
        let message = format!("{}: holds no .obj or .ply file", path.display());
        return Err(io::Error::new(io::ErrorKind::NotFound, message));
    }
    Ok(files)
}

fn fan(mesh: &mut Mesh, polygon: &[u32]) {
    for k in 1..polygon.len().saturating_sub(1) {
        mesh.triangles.push([polygon[0], polygon[k], polygon[k + 1]]);
    }
}

fn parse_obj(text: &str) -> Result<Mesh, String> {
    let mut mesh = Mesh::default();
    for (number, line) in text.lines().enumerate() {
        let mut words = line.split_ascii_whitespace();
        let wrong = |what: &str| format!("line {}: {what}: {line:?}", number + 1);
        match words.next() {
            Some("v") => {
                let numbers: Vec<f32> = words.take(3).filter_map(|word| word.parse().ok()).collect();
                mesh.positions.push(numbers.try_into().map_err(|_| wrong("not three coordinates"))?);
            }
            Some("f") => {
                let count = mesh.positions.len() as i64;
                let vertex = |word: &str| {
                    let index: i64 = word.split('/').next()?.parse().ok()?;
                    // Negative numbers count back from the latest vertex.
                    u32::try_from(if index < 0 { count.checked_add(index)? } else { index - 1 }).ok()
                };
                let polygon: Option<Vec<u32>> = words.map(vertex).collect();
                fan(&mut mesh, &polygon.ok_or_else(|| wrong("not a list of vertices"))?);
            }
            _ => {}
        }
    }
    Ok(mesh)
}

/// One property of a PLY element.
struct Property {
    name: String,
    kind: Kind,
    /// Type of the count that precedes a list.
    list: Option<Kind>,
}

#[derive(Clone, Copy)]
enum Kind {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Kind {
    fn parse(word: &str) -> Result<Self, String> {
        Ok(match word {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            other => return Err(format!("unknown property type {other:?}")),
        })
    }
}

/// The numbers of a PLY body, one after the other.
enum Body<'a> {
    Ascii(std::str::SplitAsciiWhitespace<'a>),
    Binary(&'a [u8]),
}

impl Body<'_> {
    fn next(&mut self, kind: Kind) -> Result<f64, String> {
        match self {
            Self::Ascii(words) => words.next().and_then(|word| word.parse().ok()).ok_or_else(cut),
            Self::Binary(bytes) => match kind {
                Kind::I8 => take(bytes).map(|[b]| f64::from(b as i8)),
                Kind::U8 => take(bytes).map(|[b]| f64::from(b)),
                Kind::I16 => take(bytes).map(|b| f64::from(i16::from_le_bytes(b))),
                Kind::U16 => take(bytes).map(|b| f64::from(u16::from_le_bytes(b))),
                Kind::I32 => take(bytes).map(|b| f64::from(i32::from_le_bytes(b))),
                Kind::U32 => take(bytes).map(|b| f64::from(u32::from_le_bytes(b))),
                Kind::F32 => take(bytes).map(|b| f64::from(f32::from_le_bytes(b))),
                Kind::F64 => take(bytes).map(f64::from_le_bytes),
            },
        }
    }
}

fn cut() -> String {
    "ends before its last element, or holds something that is not a number".to_owned()
}

fn take<const N: usize>(bytes: &mut &[u8]) -> Result<[u8; N], String> {
    let (value, rest) = bytes.split_first_chunk::<N>().ok_or_else(cut)?;
    *bytes = rest;
    Ok(*value)
}

fn parse_ply(bytes: &[u8]) -> Result<Mesh, String> {
    let mut body = bytes;
    let header = header_lines(&mut body)?;
    let mut binary = false;
    let mut elements: Vec<(String, usize, Vec<Property>)> = Vec::new();
    for line in &header {
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words.as_slice() {
            ["format", "ascii", _] => binary = false,
            ["format", "binary_little_endian", _] => binary = true,
            ["format", other, ..] => return Err(format!("has the format {other}")),
            ["element", name, count] => {
                let count = count.parse().map_err(|_| format!("element count {count:?} is no number"))?;
                elements.push(((*name).to_owned(), count, Vec::new()));
            }
            ["property", rest @ ..] => {
                let property = match rest {
                    ["list", count, kind, name] => Property {
                        name: (*name).to_owned(),
                        kind: Kind::parse(kind)?,
                        list: Some(Kind::parse(count)?),
                    },
                    [kind, name] => {
                        Property { name: (*name).to_owned(), kind: Kind::parse(kind)?, list: None }
                    }
                    _ => return Err(format!("unknown property {line:?}")),
                };
                elements.last_mut().ok_or("a property precedes every element")?.2.push(property);
            }
            _ => {}
        }
    }
    let text;
    let mut body = if binary {
        Body::Binary(body)
    } else {
        text = String::from_utf8_lossy(body);
        Body::Ascii(text.split_ascii_whitespace())
    };
    let mut mesh = Mesh::default();
    for (name, count, properties) in &elements {
        for _ in 0..*count {
            read_element(&mut mesh, &mut body, name, properties)?;
        }
    }
    Ok(mesh)
}

fn read_element(
    mesh: &mut Mesh,
    body: &mut Body<'_>,
    name: &str,
    properties: &[Property],
) -> Result<(), String> {
    let mut position = [f32::NAN; 3];
    for property in properties {
        let Some(count) = property.list else {
            let value = body.next(property.kind)?;
            if let Some(axis) = ["x", "y", "z"].iter().position(|&axis| axis == property.name) {
                position[axis] = value as f32;
            }
            continue;
        };
        let count = body.next(count)?;
        if !(0.0..=1e6).contains(&count) {
            return Err(format!("a list of {count} entries"));
        }
        let values: Result<Vec<f64>, String> =
            (0..count as usize).map(|_| body.next(property.kind)).collect();
        if name == "face" && matches!(property.name.as_str(), "vertex_indices" | "vertex_index") {
            let polygon: Vec<u32> = values?.into_iter().map(|v| v as u32).collect();
            fan(mesh, &polygon);
        } else {
            values?;
        }
    }
    if name == "vertex" {
        mesh.positions.push(position);
    }
    Ok(())
}

/// Writes a binary little-endian PLY: vertices `x y z nx ny nz` (float, m), faces `vertex_indices`.
pub fn write_ply(path: &Path, mesh: &Mesh) -> io::Result<()> {
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\ncomment metres, world frame, z up\nelement vertex {}\n\
         property float x\nproperty float y\nproperty float z\n\
         property float nx\nproperty float ny\nproperty float nz\n\
         element face {}\nproperty list uchar int vertex_indices\nend_header\n",
        mesh.positions.len(),
        mesh.triangles.len()
    )
    .into_bytes();
    for (position, normal) in mesh.positions.iter().zip(&mesh.normals) {
        position.iter().chain(normal).for_each(|x| bytes.extend_from_slice(&x.to_le_bytes()));
    }
    for triangle in &mesh.triangles {
        bytes.push(3);
        triangle.iter().for_each(|&v| bytes.extend_from_slice(&(v as i32).to_le_bytes()));
    }
    std::fs::File::create(path)?.write_all(&bytes)
}

#[cfg(test)]
mod tests {
    use super::{parse_obj, parse_ply, read, write_ply};
    use crate::scene::Sphere;
    use nalgebra::Point3;

    #[test]
    fn a_written_ply_reads_back() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("ball.ply");
        let mesh = Sphere { centre: Point3::new(0.1, 0.2, 0.3), radius: 0.15 }.mesh();
        write_ply(&path, &mesh).expect("writable");
        assert_eq!(read(&path).expect("readable"), mesh);
        let bytes = std::fs::read(&path).expect("readable");
        assert!(parse_ply(&bytes[..bytes.len() - 1]).is_err(), "a cut file must be refused");
    }

    #[test]
    fn polygons_and_texture_indices_of_obj_files_are_understood() {
        let text = "# comment\nv 0 0 0\nv 1 0 0 \nv 1 1 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1 4/1\nf -4 -3 -2\n";
        let mesh = parse_obj(text).expect("valid");
        assert_eq!(mesh.triangles, [[0, 1, 2], [0, 2, 3], [0, 1, 2]]);
        assert!(parse_obj("v 0 0\n").is_err());
        assert!(parse_obj("f 0 1 2\n").is_err());
    }
}
