// SPDX-License-Identifier: MIT OR Apache-2.0
//! Ground truth files: `CAMERA_INDEX.npz` per camera, and the subject's surface as a mesh.
//!
//! Arrays: `depth` (f32, camera z, m), `phase` (f32, absolute projector phase at the pixel's centre, rad; NaN
//! where nothing is), `mask` (bool, the subject), `lit` (bool), all for `crop` = [v0, v1, u0, u1] of the full
//! `shape` = [rows, columns].

use crate::optics::render::SensorTruth;
use fourdbody::base::image::Plane;
use npyz::WriterBuilder;
use npyz::npz::NpzWriter;
use npyz::zip::CompressionMethod;
use npyz::zip::write::FileOptions;
use std::fs::File;
use std::io::{self, Write};
use std::path::Path;

/// Rows and columns `[v0, v1, u0, u1]` around everything finite; all zero where nothing is.
fn crop_of(truth: &SensorTruth) -> [usize; 4] {
    let depth = &truth.depth;
    let mut crop = [usize::MAX, 0, usize::MAX, 0];
    for v in 0..depth.height() {
        let row = depth.row(v);
        let Some(first) = row.iter().position(|z| z.is_finite()) else { continue };
        let last = row.iter().rposition(|z| z.is_finite()).unwrap_or(first);
        crop = [crop[0].min(v), v + 1, crop[2].min(first), crop[3].max(last + 1)];
    }
    if crop[1] == 0 { [0; 4] } else { crop }
}

/// Writes one camera's truth.
pub fn write_npz(path: &Path, truth: &SensorTruth) -> io::Result<()> {
    let crop = crop_of(truth);
    let [v0, v1, u0, u1] = crop;
    let size = [(v1 - v0) as u64, (u1 - u0) as u64];
    let rows = v0..v1;
    let mask: Vec<bool> =
        rows.clone().flat_map(|v| truth.depth.row(v)[u0..u1].iter().map(|z| z.is_finite())).collect();
    let lit: Vec<bool> = rows.clone().flat_map(|v| truth.lit.row(v)[u0..u1].iter().copied()).collect();
    let cut = |plane: &Plane<f32>| -> Vec<f32> {
        rows.clone().flat_map(|v| plane.row(v)[u0..u1].iter().copied()).collect()
    };
    let numbers = |values: &[usize]| -> Vec<i64> { values.iter().map(|&x| x as i64).collect() };
    let mut file = NpzWriter::create(path)?;
    add(&mut file, "depth", &size, &cut(&truth.depth))?;
    add(&mut file, "phase", &size, &cut(&truth.phase))?;
    add(&mut file, "mask", &size, &mask)?;
    add(&mut file, "lit", &size, &lit)?;
    add(&mut file, "crop", &[4], &numbers(&crop))?;
    add(&mut file, "shape", &[2], &numbers(&[truth.depth.height(), truth.depth.width()]))?;
    file.zip_writer().finish()?;
    Ok(())
}

/// Adds one array, handing it to the compressor in one piece: number by number would take a hundred times
/// longer.
fn add<T: npyz::AutoSerialize + Copy>(
    file: &mut NpzWriter<io::BufWriter<File>>,
    name: &str,
    shape: &[u64],
    values: &[T],
) -> io::Result<()> {
    let mut bytes = Vec::with_capacity(std::mem::size_of_val(values) + 128);
    let mut array = npyz::WriteOptions::new().default_dtype().shape(shape).writer(&mut bytes).begin_nd()?;
    array.extend(values.iter().copied())?;
    array.finish()?;
    // Without a time of writing the same truth has the same bytes.
    let options = FileOptions::default()
        .compression_method(CompressionMethod::Deflated)
        .compression_level(Some(1))
        .last_modified_time(npyz::zip::DateTime::default());
    file.zip_writer().start_file(npyz::npz::file_name_from_array_name(name), options)?;
    file.zip_writer().write_all(&bytes)
}

#[cfg(test)]
mod tests {
    use super::write_npz;
    use crate::optics::render::SensorTruth;
    use fourdbody::base::image::Plane;
    use npyz::npz::NpzArchive;

    fn truth(empty: bool) -> SensorTruth {
        let mut truth = SensorTruth {
            depth: Plane::filled(20, 10, f32::NAN),
            phase: Plane::filled(20, 10, f32::NAN),
            lit: Plane::filled(20, 10, false),
        };
        if !empty {
            truth.depth.set(5, 2, 1.5);
            truth.depth.set(8, 6, 2.5);
            truth.phase.set(8, 6, 77.0);
            truth.lit.set(8, 6, true);
        }
        truth
    }

    #[test]
    fn arrays_read_back_with_their_types() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("h0_up_000000.npz");
        write_npz(&path, &truth(false)).expect("writable");
        let mut file = NpzArchive::open(&path).expect("a zip file");
        let mut numbers = |name: &str| -> Vec<i64> {
            let array = file.by_name(name).expect("readable").expect("present");
            array.into_vec().expect("i64")
        };
        assert_eq!(numbers("crop"), [2, 7, 5, 9]);
        assert_eq!(numbers("shape"), [10, 20]);
        let depth = file.by_name("depth").expect("readable").expect("present");
        assert_eq!(depth.shape(), [5, 4]);
        let depth: Vec<f32> = depth.into_vec().expect("f32");
        assert_eq!((depth[0], depth[19]), (1.5, 2.5));
        assert!(depth[1].is_nan());
        let lit: Vec<bool> =
            file.by_name("lit").expect("readable").expect("present").into_vec().expect("bool");
        assert_eq!(lit.iter().filter(|&&lit| lit).count(), 1);
        let mask: Vec<bool> =
            file.by_name("mask").expect("readable").expect("present").into_vec().expect("bool");
        assert_eq!(mask.iter().filter(|&&mask| mask).count(), 2);
    }

    #[test]
    fn an_empty_view_is_written_too() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("h0_up_000000.npz");
        write_npz(&path, &truth(true)).expect("writable");
        let mut file = NpzArchive::open(&path).expect("a zip file");
        assert_eq!(file.by_name("depth").expect("readable").expect("present").shape(), [0, 0]);
    }
}
