//! Binary PLY, as the command line's contract has it: `x y z` (float, metres, world), `intensity` (float, 0 to
//! 1), `nx ny nz` (float, unit, towards the camera), `u v` (ushort, source pixel), and in merged clouds `camera`
//! (uchar, place in the calibration). Little endian. Comments in the header name where the points come from.
//!
//! The reader takes exactly this layout and never trusts a length in the file.

use super::cloud::Cloud;
use std::io::{self, BufRead, Read, Write};
use std::path::{Path, PathBuf};

/// Properties of a directional cloud, in order; a merged cloud has [`CAMERA`] after them.
const PROPERTIES: [(&str, &str); 9] = [
    ("float", "x"),
    ("float", "y"),
    ("float", "z"),
    ("float", "intensity"),
    ("float", "nx"),
    ("float", "ny"),
    ("float", "nz"),
    ("ushort", "u"),
    ("ushort", "v"),
];
const CAMERA: (&str, &str) = ("uchar", "camera");

/// Bytes of a directional point.
const POINT_BYTES: usize = 7 * 4 + 2 * 2;

/// Longest header that is read: a bound for damaged files.
const MAX_HEADER_BYTES: u64 = 64 * 1024;

/// Points read at a time, so that a false count in a header cannot claim memory.
const POINTS_PER_READ: usize = 4096;

/// Why a PLY file could not be read.
#[derive(Debug, thiserror::Error)]
pub enum PlyError {
    /// The file could not be opened or read.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The file is not a cloud of this project, or is damaged.
    #[error("{path}: {reason}; expected a binary PLY as `fourdbody reconstruct` writes it")]
    Format {
        /// The file.
        path: PathBuf,
        /// What was found.
        reason: String,
    },
}

/// What a header says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Header {
    /// Number of points.
    pub points: usize,
    /// Whether the points carry their camera.
    pub merged: bool,
    /// The comments, in order.
    pub comments: Vec<String>,
}

impl Header {
    /// The rest of the first comment that starts with `key` and a space.
    pub fn comment(&self, key: &str) -> Option<&str> {
        self.comments.iter().find_map(|c| c.strip_prefix(key)?.strip_prefix(' '))
    }
}

/// Writes a cloud. Line breaks in comments become spaces. The arrays must have equal lengths, as those of a
/// [`Cloud`] have.
pub fn write(mut out: impl Write, cloud: &Cloud, comments: &[String]) -> io::Result<()> {
    let merged = cloud.is_merged();
    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    for comment in comments {
        header += &format!("comment {}\n", comment.replace(['\n', '\r'], " "));
    }
    header += &format!("element vertex {}\n", cloud.len());
    for (kind, name) in PROPERTIES.iter().chain(merged.then_some(&CAMERA)) {
        header += &format!("property {kind} {name}\n");
    }
    header += "end_header\n";
    out.write_all(header.as_bytes())?;
    let stride = POINT_BYTES + usize::from(merged);
    let mut bytes = Vec::with_capacity(cloud.len() * stride);
    let points = cloud.position_m.iter().zip(&cloud.normal).zip(&cloud.intensity).zip(&cloud.pixel);
    for (i, (((position, normal), intensity), pixel)) in points.enumerate() {
        for x in position.iter().chain([intensity]).chain(normal) {
            bytes.extend_from_slice(&x.to_le_bytes());
        }
        for x in pixel {
            bytes.extend_from_slice(&x.to_le_bytes());
        }
        bytes.extend(cloud.camera.get(i));
    }
    out.write_all(&bytes)
}

/// Writes a cloud to a file through a temporary neighbour, so that it is never half there.
pub fn save(path: &Path, cloud: &Cloud, comments: &[String]) -> io::Result<()> {
    let partial = path.with_extension("ply.partial");
    let mut file = io::BufWriter::new(std::fs::File::create(&partial)?);
    write(&mut file, cloud, comments)?;
    file.into_inner().map_err(io::IntoInnerError::into_error)?;
    std::fs::rename(&partial, path)
}

/// Reads the header of a file.
pub fn load_header(path: &Path) -> Result<Header, PlyError> {
    let file = std::fs::File::open(path).map_err(|source| PlyError::Io { path: path.to_owned(), source })?;
    read_header(&mut io::BufReader::new(file))
        .map_err(|reason| PlyError::Format { path: path.to_owned(), reason })
}

/// Reads a file.
pub fn load(path: &Path) -> Result<(Header, Cloud), PlyError> {
    let file = std::fs::File::open(path).map_err(|source| PlyError::Io { path: path.to_owned(), source })?;
    read(io::BufReader::new(file)).map_err(|reason| PlyError::Format { path: path.to_owned(), reason })
}

/// Reads a cloud; an error says what was found instead.
pub fn read(mut input: impl BufRead) -> Result<(Header, Cloud), String> {
    let header = read_header(&mut input)?;
    let stride = POINT_BYTES + usize::from(header.merged);
    let mut cloud = Cloud::default();
    let mut bytes = vec![0; stride * POINTS_PER_READ];
    let mut left = header.points;
    while left > 0 {
        let count = left.min(POINTS_PER_READ);
        let part = &mut bytes[..count * stride];
        input.read_exact(part).map_err(|e| {
            format!("{} points announced, the data end after {} ({e})", header.points, header.points - left)
        })?;
        part.chunks_exact(stride).for_each(|point| push(&mut cloud, point));
        left -= count;
    }
    match input.read(&mut [0]) {
        Ok(0) => Ok((header, cloud)),
        Ok(_) => Err(format!("there are more data than the {} points announced", header.points)),
        Err(e) => Err(e.to_string()),
    }
}

fn push(cloud: &mut Cloud, point: &[u8]) {
    let float = |i: usize| f32::from_le_bytes(std::array::from_fn(|k| point[4 * i + k]));
    let short = |i: usize| u16::from_le_bytes([point[28 + 2 * i], point[29 + 2 * i]]);
    cloud.position_m.push([float(0), float(1), float(2)]);
    cloud.intensity.push(float(3));
    cloud.normal.push([float(4), float(5), float(6)]);
    cloud.pixel.push([short(0), short(1)]);
    cloud.camera.extend(point.get(POINT_BYTES));
}

fn read_header(input: &mut impl BufRead) -> Result<Header, String> {
    let mut limited = input.take(MAX_HEADER_BYTES);
    let mut line = || -> Result<String, String> {
        let mut bytes = Vec::new();
        limited.read_until(b'\n', &mut bytes).map_err(|e| e.to_string())?;
        if bytes.pop() != Some(b'\n') {
            return Err(format!("the header does not end within {MAX_HEADER_BYTES} bytes"));
        }
        String::from_utf8(bytes).map_err(|_| "the header is not text".to_owned())
    };
    for expected in ["ply", "format binary_little_endian 1.0"] {
        let found = line()?;
        if found != expected {
            return Err(format!("expected the line {expected:?}, found {found:?}"));
        }
    }
    let mut comments = Vec::new();
    let points = loop {
        let text = line()?;
        if let Some(comment) = text.strip_prefix("comment ") {
            comments.push(comment.to_owned());
        } else if let Some(count) = text.strip_prefix("element vertex ") {
            break count.parse::<usize>().map_err(|e| format!("{text:?}: {e}"))?;
        } else {
            return Err(format!("expected the element vertex, found {text:?}"));
        }
    };
    for (kind, name) in PROPERTIES {
        let (expected, found) = (format!("property {kind} {name}"), line()?);
        if found != expected {
            return Err(format!("expected the line {expected:?}, found {found:?}"));
        }
    }
    let (kind, name) = CAMERA;
    let mut last = line()?;
    let merged = last == format!("property {kind} {name}");
    if merged {
        last = line()?;
    }
    if last != "end_header" {
        return Err(format!("expected the end of the header, found {last:?}"));
    }
    Ok(Header { points, merged, comments })
}

#[cfg(test)]
mod tests {
    use super::{read, write};
    use crate::export::Cloud;
    use proptest::prelude::{any, prop_assert, prop_assert_eq, proptest};

    fn cloud(points: usize, merged: bool) -> Cloud {
        let x = |i: usize| i as f32 * 0.25 - 3.0;
        Cloud {
            position_m: (0..points).map(|i| [x(i), -x(i), x(i) + 0.5]).collect(),
            normal: (0..points).map(|i| [0.0, (i % 2) as f32, 1.0 - (i % 2) as f32]).collect(),
            intensity: (0..points).map(|i| i as f32 / points as f32).collect(),
            pixel: (0..points).map(|i| [i as u16, 1199]).collect(),
            camera: if merged { (0..points).map(|i| (i % 8) as u8).collect() } else { Vec::new() },
            sigma_m: Vec::new(),
        }
    }

    #[test]
    fn the_bytes_of_a_point_are_those_of_the_contract() {
        let mut bytes = Vec::new();
        write(&mut bytes, &cloud(1, true), &["calibration abc\ndef".to_owned()]).expect("memory");
        let header = "ply\nformat binary_little_endian 1.0\ncomment calibration abc def\nelement vertex 1\n\
            property float x\nproperty float y\nproperty float z\nproperty float intensity\nproperty float nx\n\
            property float ny\nproperty float nz\nproperty ushort u\nproperty ushort v\nproperty uchar camera\n\
            end_header\n";
        assert_eq!(String::from_utf8_lossy(&bytes[..header.len()]), header);
        let mut data = Vec::new();
        for x in [-3.0f32, 3.0, -2.5, 0.0, 0.0, 0.0, 1.0] {
            data.extend(x.to_le_bytes());
        }
        data.extend([0, 0, 0xaf, 0x04, 0]);
        assert_eq!(&bytes[header.len()..], data);
    }

    proptest! {
        #[test]
        fn clouds_survive(points in 0usize..9000, merged in any::<bool>()) {
            let cloud = cloud(points, merged);
            let mut bytes = Vec::new();
            write(&mut bytes, &cloud, &["camera h0_up".to_owned()]).expect("memory");
            let (header, back) = read(bytes.as_slice()).expect("intact");
            prop_assert_eq!(header.points, points);
            prop_assert_eq!(header.comment("camera"), Some("h0_up"));
            prop_assert_eq!(back, cloud);
        }

        #[test]
        fn damage_is_an_error_and_no_panic(cut in 0usize..700, at in 0usize..700, value in any::<u8>()) {
            let mut bytes = Vec::new();
            write(&mut bytes, &cloud(10, true), &[]).expect("memory");
            let whole = bytes.len();
            if let Some(byte) = bytes.get_mut(at) {
                *byte = value;
            }
            let _ = read(bytes.as_slice());
            bytes.truncate(cut.min(whole - 1));
            prop_assert!(read(bytes.as_slice()).is_err());
        }
    }

    #[test]
    fn a_huge_count_claims_no_memory() {
        let mut bytes = Vec::new();
        write(&mut bytes, &cloud(3, false), &[]).expect("memory");
        let text = String::from_utf8_lossy(&bytes).replace("vertex 3", "vertex 18446744073709551615");
        assert!(read(text.as_bytes()).is_err());
    }
}
