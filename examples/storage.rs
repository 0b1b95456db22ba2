// SPDX-License-Identifier: MIT OR Apache-2.0
//! What each form of a cloud costs: bytes, and the time to write and to read it, in memory and on this machine's disk
//! cache. Least of many runs on one thread.
//!
//! ```text
//! fourdbody reconstruct SESSION --calibration FILE --out DIR
//! cargo run --release --example storage -- DIR FILE
//! ```

use fourdbody::data::Calibration;
use fourdbody::formats::sequence::SequenceWriter;
use fourdbody::formats::{phase_file, ply};
use fourdbody::reconstruct::triangulate::camera_projector::CameraProjector;
use fourdbody::reconstruct::triangulate::points;
use fourdbody::reconstruct::triangulate::ray_table::RayTable;
use std::hint::black_box;
use std::path::Path;
use std::time::Instant;

const RUNS: usize = 25;

/// Least time of some runs, ms.
fn least<T>(mut work: impl FnMut() -> T) -> f64 {
    let once = || {
        let start = Instant::now();
        black_box(work());
        start.elapsed().as_secs_f64() * 1e3
    };
    std::iter::repeat_with(once).take(RUNS).fold(f64::INFINITY, f64::min)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [directory, calibration] = arguments.as_slice() else {
        return Err("expected: DIR (with phases/ in it) CALIBRATION".into());
    };
    let calibration = Calibration::load(Path::new(calibration))?;
    let scratch = std::env::temp_dir().join(format!("fourdbody-storage-{}", std::process::id()));
    let (mut frames, mut points) = (0.0, 0.0);
    let (mut bytes, mut write, mut read) = ([0.0; 3], [0.0; 3], [0.0; 3]);
    let mut made = 0.0;
    for entry in std::fs::read_dir(Path::new(directory).join("phases"))? {
        let stored = std::fs::read(entry?.path())?;
        let (statement, map) = phase_file::decode(&stored)?;
        let known = calibration.cameras().find(|(_, camera)| camera.id.as_str() == statement.camera);
        let (head, camera) = known.ok_or("the calibration has no such camera")?;
        let table = RayTable::new(&CameraProjector::new(head, camera, &calibration)?);
        let cloud = points::make(&table, &map);
        frames += 1.0;
        points += cloud.len() as f64;
        made += least(|| points::make(&table, &map));
        // A phase map.
        bytes[0] += stored.len() as f64;
        write[0] += least(|| phase_file::save(&scratch, &statement, &map));
        read[0] += least(|| phase_file::load(&scratch).map(|(_, map)| points::make(&table, &map)));
        // A PLY file.
        write[1] += least(|| ply::save(&scratch, &cloud, &statement.comments));
        bytes[1] += std::fs::metadata(&scratch)?.len() as f64;
        read[1] += least(|| ply::load(&scratch));
        // A message of a sequence.
        let sequence = || -> Result<(), Box<dyn std::error::Error>> {
            let file = std::io::BufWriter::new(std::fs::File::create(&scratch)?);
            let mut writer = SequenceWriter::new(file)?;
            writer.push(0, &cloud)?;
            writer.finish()?;
            Ok(())
        };
        write[2] += least(sequence);
        bytes[2] += std::fs::metadata(&scratch)?.len() as f64;
        read[2] += least(|| {
            let bytes = std::fs::read(&scratch).unwrap_or_default();
            mcap::MessageStream::new(&bytes).map(|messages| messages.count())
        });
    }
    std::fs::remove_file(&scratch)?;
    println!(
        "{frames} frames of {:.0} points; points and normals from a map: {:.2} ms",
        points / frames,
        made / frames
    );
    println!("{:<12} {:>14} {:>12} {:>12}", "", "bytes a point", "write ms", "read ms");
    for (i, name) in ["phase map", "PLY", "PointCloud"].into_iter().enumerate() {
        let (bytes, write, read) = (bytes[i] / points, write[i] / frames, read[i] / frames);
        println!("{name:<12} {bytes:>14.2} {write:>12.2} {read:>12.2}");
    }
    Ok(())
}
