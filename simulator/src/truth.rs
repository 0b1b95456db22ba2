// SPDX-License-Identifier: MIT OR Apache-2.0
//! Ground truth files: `CAMERA_INDEX.npz` per camera, and the subject's surface as a mesh.
//!
//! Arrays: `depth` (f32, camera z, m), `phase` (f32, absolute projector phase at the pixel's centre, rad; NaN
//! where nothing is), `mask` (bool, the subject), `lit` (bool), all for `crop` = [v0, v1, u0, u1] of the full
//! `shape` = [rows, columns].

use crate::optics::render::SensorTruth;
use fourdbody::base::image::Plane;
use fourdbody::formats::npz::NpzWriter;
use std::io;
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

/// Writes the ground truth of one camera as arrays of NumPy.
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
    file.add("depth", &size, &cut(&truth.depth))?;
    file.add("phase", &size, &cut(&truth.phase))?;
    file.add("mask", &size, &mask)?;
    file.add("lit", &size, &lit)?;
    file.add("crop", &[4], &numbers(&crop))?;
    file.add("shape", &[2], &numbers(&[truth.depth.height(), truth.depth.width()]))?;
    file.finish()
}

#[cfg(test)]
mod tests {
    use super::write_npz;
    use crate::optics::render::SensorTruth;
    use fourdbody::base::image::Plane;
    use fourdbody::formats::npz::NpzReader;

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
        let mut file = NpzReader::open(&path).expect("a zip file");
        let mut numbers = |name: &str| file.array::<i64>(name).expect("i64").1;
        assert_eq!(numbers("crop"), [2, 7, 5, 9]);
        assert_eq!(numbers("shape"), [10, 20]);
        let (shape, depth) = file.array::<f32>("depth").expect("f32");
        assert_eq!(shape, [5, 4]);
        assert_eq!((depth[0], depth[19]), (1.5, 2.5));
        assert!(depth[1].is_nan());
        for (name, expected) in [("lit", 1), ("mask", 2)] {
            let (_, set) = file.array::<bool>(name).expect("bool");
            assert_eq!(set.iter().filter(|&&set| set).count(), expected, "{name}");
        }
        assert!(file.array::<f32>("normal").is_err_and(|e| e.contains("normal")), "there is none");
    }

    #[test]
    fn an_empty_view_is_written_too() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("h0_up_000000.npz");
        write_npz(&path, &truth(true)).expect("writable");
        let mut file = NpzReader::open(&path).expect("a zip file");
        assert_eq!(file.array::<f32>("depth").expect("f32"), (vec![0, 0], vec![]));
    }
}
