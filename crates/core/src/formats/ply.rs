// SPDX-License-Identifier: MIT OR Apache-2.0
//! Binary PLY, as the command line's contract has it: `x y z` (float, metres, world), `intensity` (float, 0 to
//! 1), `nx ny nz` (float, unit, towards the camera), `u v` (ushort, source pixel), and in merged clouds `camera`
//! (uchar, place in the calibration). With `--uncertainty`, `sigma` comes last (float, metres: the standard uncertainty
//! along the line of sight). Little endian. Comments in the header name where the points come from.
//!
//! The reader takes exactly this layout and never trusts a length in the file.

use crate::base::{FileError, regular, write_whole_cached};
use crate::data::{Cloud, NO_CAMERA};
use std::fs::File;
use std::io::{self, BufRead, Read, Seek, Write};
use std::path::Path;

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
const SIGMA: (&str, &str) = ("float", "sigma");

/// Bytes of a directional point.
const POINT_BYTES: usize = 7 * 4 + 2 * 2;

/// The most points of a file: all cameras of a trigger have fewer.
const POINTS_MAX: usize = 1 << 27;
/// The most points whose memory is reserved before they are read.
const ROOM_MAX: usize = 1 << 22;
/// The longest header that is read, bytes: a bound for damaged files.
const MAX_HEADER_BYTES: u64 = 64 * 1024;

/// Points read or written at a time: so a false count in a header cannot claim memory.
const POINTS_AT_ONCE: usize = 4096;

/// The optional properties that the points of a file have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Layout {
    merged: bool,
    sigma: bool,
}

impl Layout {
    fn properties(self) -> impl Iterator<Item = &'static (&'static str, &'static str)> {
        PROPERTIES.iter().chain(self.merged.then_some(&CAMERA)).chain(self.sigma.then_some(&SIGMA))
    }

    /// Bytes of one point with these properties.
    fn stride(self) -> usize {
        POINT_BYTES + usize::from(self.merged) + 4 * usize::from(self.sigma)
    }
}

/// What the header of a file states.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Header {
    pub points: usize,
    /// Whether the points carry their camera.
    pub merged: bool,
    /// Whether the points carry their standard uncertainty.
    pub sigma: bool,
    pub comments: Vec<String>,
}

impl Header {
    fn layout(&self) -> Layout {
        Layout { merged: self.merged, sigma: self.sigma }
    }

    /// The rest of the first comment that starts with `key` and a space.
    pub fn comment(&self, key: &str) -> Option<&str> {
        self.comments.iter().find_map(|c| c.strip_prefix(key)?.strip_prefix(' '))
    }
}

/// A directional cloud as a part of a merged one.
#[derive(Debug, Clone, Copy)]
pub struct Part<'a> {
    /// Its camera's number in merged clouds.
    pub camera: u8,
    pub cloud: &'a Cloud,
    /// Whether each of its points is left out; empty where none is.
    pub left_out: &'a [bool],
}

impl Part<'_> {
    /// Number of points that are written.
    pub fn points(&self) -> usize {
        self.cloud.len() - self.left_out.iter().filter(|out| **out).count()
    }
}

/// Writes a cloud. Line breaks in comments become spaces. The arrays must have equal lengths, as those of a
/// [`Cloud`] have.
pub fn write(mut out: impl Write, cloud: &Cloud, comments: &[String]) -> io::Result<()> {
    let layout = Layout { merged: cloud.is_merged(), sigma: !cloud.sigma_m.is_empty() };
    out.write_all(header(cloud.len(), layout, comments).as_bytes())?;
    write_points(&mut out, cloud, layout, |_| true, None)
}

/// Writes a merged cloud without putting it together first.
pub fn write_merged(mut out: impl Write, parts: &[Part<'_>], comments: &[String]) -> io::Result<()> {
    let full = || parts.iter().filter(|part| part.points() > 0);
    let sigma = full().next().is_some() && full().all(|part| !part.cloud.sigma_m.is_empty());
    // A merged cloud without points has no camera to state.
    let layout = Layout { merged: full().next().is_some(), sigma };
    let points = parts.iter().map(Part::points).sum();
    out.write_all(header(points, layout, comments).as_bytes())?;
    for &Part { camera, cloud, left_out } in parts {
        if left_out.is_empty() {
            write_points(&mut out, cloud, layout, |_| true, Some(camera))?;
        } else {
            write_points(&mut out, cloud, layout, |i| !left_out[i], Some(camera))?;
        }
    }
    Ok(())
}

fn header(points: usize, layout: Layout, comments: &[String]) -> String {
    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    for comment in comments {
        header += &format!("comment {}\n", comment.replace(['\n', '\r'], " "));
    }
    header += &format!("element vertex {points}\n");
    for (kind, name) in layout.properties() {
        header += &format!("property {kind} {name}\n");
    }
    header + "end_header\n"
}

/// Writes the points for whose places `keep` is true, some thousand at a time through a buffer that stays in the cache.
/// `camera`: the number of their camera, where the cloud itself does not have it.
fn write_points(
    out: &mut impl Write,
    cloud: &Cloud,
    layout: Layout,
    keep: impl Fn(usize) -> bool,
    camera: Option<u8>,
) -> io::Result<()> {
    let stride = layout.stride();
    let mut bytes = vec![0; stride * POINTS_AT_ONCE];
    for first in (0..cloud.len()).step_by(POINTS_AT_ONCE) {
        let part = first..cloud.len().min(first + POINTS_AT_ONCE);
        let kept = || part.clone().filter(|&i| keep(i));
        let points = cloud.position_m[part.clone()].iter().zip(&cloud.normal[part.clone()]);
        let points = points.zip(&cloud.intensity[part.clone()]).zip(&cloud.pixel[part.clone()]);
        let points = part.clone().zip(points).filter(|(i, _)| keep(*i));
        let filled = bytes.chunks_exact_mut(stride).zip(points).map(|(to, (_, (((p, n), i), [u, v])))| {
            let floats = [p[0], p[1], p[2], *i, n[0], n[1], n[2]];
            for (to, x) in to.as_chunks_mut::<4>().0.iter_mut().zip(floats) {
                *to = x.to_le_bytes();
            }
            to[28..30].copy_from_slice(&u.to_le_bytes());
            to[30..32].copy_from_slice(&v.to_le_bytes());
        });
        let count = filled.count();
        let bytes = &mut bytes[..count * stride];
        if layout.merged {
            for (i, to) in kept().zip(bytes.chunks_exact_mut(stride)) {
                let own = || cloud.camera.get(i).copied().unwrap_or(NO_CAMERA);
                to[POINT_BYTES] = camera.unwrap_or_else(own);
            }
        }
        if layout.sigma {
            for (i, to) in kept().zip(bytes.chunks_exact_mut(stride)) {
                to[stride - 4..].copy_from_slice(&cloud.sigma_m[i].to_le_bytes());
            }
        }
        out.write_all(bytes)?;
    }
    Ok(())
}

/// Writes a cloud to a file through a temporary neighbour, so that it is never half there.
pub fn save(path: &Path, cloud: &Cloud, comments: &[String]) -> io::Result<()> {
    write_whole_cached(path, |file| write(file, cloud, comments))
}

/// Writes directional clouds as one merged cloud, in their order. The file is the same as that of the cloud that
/// [`merge::merged`](crate::merge::merged) makes of them.
pub fn save_merged(path: &Path, parts: &[Part<'_>], comments: &[String]) -> io::Result<()> {
    write_whole_cached(path, |file| write_merged(file, parts, comments))
}

/// The error of a file that is no cloud of this project, or is damaged.
fn unfit(path: &Path, reason: &str) -> FileError {
    FileError::of(path)(format!("{reason}; expected a binary PLY as `fourdbody reconstruct` writes it"))
}

/// Opens a file; its length in bytes.
fn open(path: &Path) -> Result<(io::BufReader<File>, u64), FileError> {
    let file = regular::open(path).map_err(FileError::of(path))?;
    let bytes = file.metadata().map_err(FileError::of(path))?.len();
    Ok((io::BufReader::new(file), bytes))
}

/// Reads the header of a file.
pub fn load_header(path: &Path) -> Result<Header, FileError> {
    read_header(&mut open(path)?.0).map_err(|reason| unfit(path, &reason))
}

/// Reads the header of a file and makes sure that the file is as long as it states, without reading the points.
pub fn load_whole_header(path: &Path) -> Result<Header, FileError> {
    let (mut input, found) = open(path)?;
    let header = read_header(&mut input).map_err(|reason| unfit(path, &reason))?;
    let points = (header.points as u64).checked_mul(header.layout().stride() as u64);
    let stated = points.and_then(|bytes| bytes.checked_add(input.stream_position().ok()?));
    if stated != Some(found) {
        return Err(unfit(path, &format!("{} points announced, the file has {found} bytes", header.points)));
    }
    Ok(header)
}

/// Reads a file: its header, and its cloud.
pub fn load(path: &Path) -> Result<(Header, Cloud), FileError> {
    let (input, bytes) = open(path)?;
    read_at_most(input, bytes).map_err(|reason| unfit(path, &reason))
}

/// Reads a cloud; an error states what was found instead.
pub fn read(input: impl BufRead) -> Result<(Header, Cloud), String> {
    read_at_most(input, 0)
}

/// Reads a cloud from data that are known to have this number of bytes (0: not known).
fn read_at_most(mut input: impl BufRead, bytes: u64) -> Result<(Header, Cloud), String> {
    let header = read_header(&mut input)?;
    let layout = header.layout();
    let mut cloud = Cloud::default();
    let stated = usize::try_from(bytes).unwrap_or(0) / layout.stride();
    let room = header.points.min(stated).min(ROOM_MAX);
    cloud.position_m.reserve_exact(room);
    cloud.normal.reserve_exact(room);
    cloud.intensity.reserve_exact(room);
    cloud.pixel.reserve_exact(room);
    cloud.camera.reserve_exact(if layout.merged { room } else { 0 });
    cloud.sigma_m.reserve_exact(if layout.sigma { room } else { 0 });
    let mut bytes = vec![0; layout.stride() * POINTS_AT_ONCE];
    let mut left = header.points;
    while left > 0 {
        let count = left.min(POINTS_AT_ONCE);
        let part = &mut bytes[..count * layout.stride()];
        input.read_exact(part).map_err(|e| {
            format!("{} points announced, the data end after {} ({e})", header.points, header.points - left)
        })?;
        for point in part.chunks_exact(layout.stride()) {
            // Zeros are a hole of a file that was cut: no point has a normal of length 0.
            if point[..POINT_BYTES].iter().all(|byte| *byte == 0) {
                return Err("a point of zeros alone: the file was not written to its end".to_owned());
            }
            push(&mut cloud, point, layout);
        }
        left -= count;
    }
    match input.read(&mut [0]) {
        Ok(0) => Ok((header, cloud)),
        Ok(_) => Err(format!("there are more data than the {} points announced", header.points)),
        Err(e) => Err(e.to_string()),
    }
}

fn push(cloud: &mut Cloud, point: &[u8], layout: Layout) {
    let float_at = |at: usize| f32::from_le_bytes(std::array::from_fn(|k| point[at + k]));
    let float = |i: usize| float_at(4 * i);
    let short = |i: usize| u16::from_le_bytes([point[28 + 2 * i], point[29 + 2 * i]]);
    cloud.position_m.push([float(0), float(1), float(2)]);
    cloud.intensity.push(float(3));
    cloud.normal.push([float(4), float(5), float(6)]);
    cloud.pixel.push([short(0), short(1)]);
    if layout.merged {
        cloud.camera.push(point[POINT_BYTES]);
    }
    if layout.sigma {
        cloud.sigma_m.push(float_at(point.len() - 4));
    }
}

/// The lines of a PLY file's header before `end_header`; the input stands behind it then. Any PLY file has such lines.
pub fn header_lines(input: &mut impl BufRead) -> Result<Vec<String>, String> {
    let mut limited = input.take(MAX_HEADER_BYTES);
    let mut lines = Vec::new();
    loop {
        let mut line = Vec::new();
        limited.read_until(b'\n', &mut line).map_err(|e| e.to_string())?;
        if line.pop() != Some(b'\n') {
            return Err(format!("the header does not end within {MAX_HEADER_BYTES} bytes"));
        }
        let line = String::from_utf8(line).map_err(|_| "the header is not text".to_owned())?;
        if line.trim_end() == "end_header" {
            return Ok(lines);
        }
        lines.push(line);
    }
}

fn read_header(input: &mut impl BufRead) -> Result<Header, String> {
    let lines = header_lines(input)?;
    let mut lines = lines.iter().map(String::as_str);
    for expected in ["ply", "format binary_little_endian 1.0"] {
        let found = lines.next().unwrap_or_default();
        if found != expected {
            return Err(format!("expected the line {expected:?}, found {found:?}"));
        }
    }
    let mut comments = Vec::new();
    let points = loop {
        let text = lines.next().unwrap_or_default();
        if let Some(comment) = text.strip_prefix("comment ") {
            comments.push(comment.to_owned());
        } else if let Some(count) = text.strip_prefix("element vertex ") {
            break count.parse::<usize>().map_err(|e| format!("{text:?}: {e}"))?;
        } else {
            return Err(format!("expected the element vertex, found {text:?}"));
        }
    };
    if points > POINTS_MAX {
        return Err(format!("expected at most {POINTS_MAX} points, found {points}"));
    }
    let found: Vec<&str> = lines.collect();
    let is_found = |layout: &Layout| {
        let expected = layout.properties().map(|(kind, name)| format!("property {kind} {name}"));
        expected.eq(found.iter().copied())
    };
    let layouts = [(false, false), (false, true), (true, false), (true, true)];
    let layout = layouts.map(|(merged, sigma)| Layout { merged, sigma }).into_iter().find(is_found);
    let Layout { merged, sigma } = layout.ok_or_else(|| {
        format!("expected x y z intensity nx ny nz u v, camera and sigma at most, found {}", found.join(", "))
    })?;
    Ok(Header { points, merged, sigma, comments })
}

#[cfg(test)]
mod tests {
    use super::{read, write};
    use crate::data::Cloud;
    use proptest::prelude::{any, prop_assert, prop_assert_eq, proptest};

    fn cloud(points: usize, merged: bool, sigma: bool) -> Cloud {
        let x = |i: usize| i as f32 * 0.25 - 3.0;
        Cloud {
            position_m: (0..points).map(|i| [x(i), -x(i), x(i) + 0.5]).collect(),
            normal: (0..points).map(|i| [0.0, (i % 2) as f32, 1.0 - (i % 2) as f32]).collect(),
            intensity: (0..points).map(|i| i as f32 / points as f32).collect(),
            pixel: (0..points).map(|i| [i as u16, 1199]).collect(),
            camera: if merged { (0..points).map(|i| (i % 8) as u8).collect() } else { Vec::new() },
            sigma_m: if sigma { (0..points).map(|i| i as f32 * 1e-6).collect() } else { Vec::new() },
        }
    }

    #[test]
    fn the_bytes_of_a_point_are_those_of_the_contract() {
        let mut bytes = Vec::new();
        write(&mut bytes, &cloud(1, true, false), &["calibration abc\ndef".to_owned()]).expect("memory");
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
        fn clouds_survive(points in 0usize..9000, merged in any::<bool>(), sigma in any::<bool>()) {
            let cloud = cloud(points, merged, sigma);
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
            write(&mut bytes, &cloud(10, true, at % 2 == 0), &[]).expect("memory");
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
        write(&mut bytes, &cloud(3, false, false), &[]).expect("memory");
        let text = String::from_utf8_lossy(&bytes).replace("vertex 3", "vertex 18446744073709551615");
        assert!(read(text.as_bytes()).is_err());
    }
}
