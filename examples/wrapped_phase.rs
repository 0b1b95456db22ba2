// SPDX-License-Identifier: MIT OR Apache-2.0
//! The phase maps of one photograph, for comparison with other programs (`benches/peers`).
//!
//! ```text
//! wrapped_phase IMAGE.png OUT.npz --calibration calibration.json CAMERA
//! wrapped_phase IMAGE.png OUT.npz --period PX
//! ```
//!
//! With `--period` the photograph need not be from our instrument: a camera and a projector side by side are made up for
//! it, whose fringes run along the image's rows' normal with this period; there is then no use in the absolute phase.
//! OUT has `wrapped` and `absolute` (f32, rad, NaN where unknown) for the whole frame; without a marker nothing is absolute.
//! Prints one JSON object: the stages, ms, median and least of seven runs after one.

use fourdbody::base::ids::CameraId;
use fourdbody::base::image::{Mono8, Plane, read_png_grey};
use fourdbody::data::{CalibratedCamera, CalibratedHead, Calibration};
use fourdbody::formats::npz::NpzWriter;
use fourdbody::geometry::pattern::{Marker, Pattern};
use fourdbody::geometry::{Device, Lens, Pose};
use fourdbody::reconstruct::outcome::Maps;
use fourdbody::reconstruct::pipeline::{Method, Pipeline};
use fourdbody::reconstruct::triangulate::camera_projector::CameraProjector;
use fourdbody::reconstruct::triangulate::triangulator::Triangulator;
use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use std::collections::BTreeMap;
use std::path::Path;

const USAGE: &str = "usage: wrapped_phase IMAGE.png OUT.npz (--calibration FILE CAMERA | --period PX)";

/// Runs that are timed, after one that is not.
const RUNS: usize = 7;

type Failure = Box<dyn std::error::Error>;

fn main() -> Result<(), Failure> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let (image, out, pair) = match words[..] {
        [image, out, "--period", period] => {
            let plane = read_png_grey(Path::new(image))?;
            let pair = side_by_side(plane.width(), plane.height(), period.parse()?)?;
            (plane, out, pair)
        }
        [image, out, "--calibration", file, camera] => {
            let calibration = Calibration::load(Path::new(file))?;
            let camera = CameraId::from(camera);
            let found = calibration.cameras().find(|(_, c)| c.id == camera);
            let (head, camera) = found.ok_or_else(|| format!("{file}: there is no camera {camera}"))?;
            (read_png_grey(Path::new(image))?, out, CameraProjector::new(head, camera, &calibration)?)
        }
        _ => return Err(USAGE.into()),
    };
    let timed = Pipeline::new(Triangulator::new(pair.clone()), Method::Joint, false);
    let mut stages: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
    for run in 0..=RUNS {
        let mut times: BTreeMap<&str, f64> = BTreeMap::new();
        for (stage, time) in timed.run(Mono8::from(&image)).stages {
            *times.entry(stage).or_default() += 1e3 * time.as_secs_f64();
        }
        if run > 0 {
            times.into_iter().for_each(|(stage, ms)| stages.entry(stage).or_default().push(ms));
        }
    }
    let pipeline = Pipeline::new(Triangulator::new(pair), Method::Joint, true);
    let result = pipeline.run(Mono8::from(&image));
    let maps = result.maps.ok_or_else(|| format!("{:?}", result.outcome))?;
    write(Path::new(out), &maps, &[("wrapped", "Wm"), ("absolute", "Fm")])?;
    let figure = |times: &mut Vec<f64>| {
        times.sort_by(f64::total_cmp);
        serde_json::json!({"median_ms": times[times.len() / 2], "least_ms": times[0]})
    };
    let stages: serde_json::Map<String, serde_json::Value> =
        stages.iter_mut().map(|(stage, times)| ((*stage).to_owned(), figure(times))).collect();
    println!("{}", serde_json::json!({"stages": stages, "object_px": result.counts.object}));
    Ok(())
}

/// A camera and a projector 0.3 m apart that look the same way, 2 m from the volume's middle.
fn side_by_side(width: usize, height: usize, period_px: f64) -> Result<CameraProjector, Failure> {
    let device = |x: f64| {
        let lens = Lens {
            fx: 1000.0,
            fy: 1000.0,
            cx: width as f64 / 2.0,
            cy: height as f64 / 2.0,
            distortion: [0.0; 5],
        };
        let pose = Isometry3::from_parts(Vector3::new(x, 0.0, -1.0).into(), UnitQuaternion::identity());
        Device { width, height, lens, world_from_device: Pose::new(pose) }
    };
    let mut calibration: Calibration = example()?;
    let (head, camera) = calibration.cameras().next().ok_or("the example rig has no camera")?;
    let camera = CalibratedCamera { device: device(0.0), ..camera.clone() };
    let head = CalibratedHead { projector: device(0.3), cameras: vec![camera.clone()], ..head.clone() };
    calibration.pattern = Pattern {
        period_px,
        // Beyond the panel: these photographs have no marker.
        marker_index: 1_000_000,
        marker_every: 0,
        marker: Marker::Darkened { depth: 0.8 },
        marker_period_px: period_px,
        low: 0.0,
        high: 1.0,
        gamma: 1.0,
    };
    (calibration.volume_min_m, calibration.volume_max_m) = ([-1.0, -1.0, 0.5], [1.0, 1.0, 1.5]);
    Ok(CameraProjector::new(&head, &camera, &calibration)?)
}

/// Any calibration to change: that of the rig as it should be.
fn example() -> Result<Calibration, Failure> {
    let rig = fourdbody::config::Rig::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml"))?;
    let heads = rig.heads.iter().map(|head| CalibratedHead {
        id: head.id.clone(),
        channel: head.channel,
        projector: head.projector.clone(),
        rows: None,
        cameras: head
            .cameras
            .iter()
            .map(|camera| CalibratedCamera { id: camera.id.clone(), device: camera.device.clone() })
            .collect(),
    });
    Ok(Calibration::new(&rig, "nominal".to_owned(), heads.collect()))
}

/// Writes maps as arrays of the whole frame: the arrays' names, and which maps they are.
fn write(path: &Path, maps: &Maps, arrays: &[(&str, &str)]) -> Result<(), Failure> {
    let mut file = NpzWriter::create(path)?;
    for &(array, map) in arrays {
        let plane = maps.planes.iter().find(|(name, _)| *name == map).map(|(_, plane)| plane);
        let plane = plane.ok_or_else(|| format!("the pipeline keeps no map {map}"))?;
        let (width, height) = maps.frame;
        let mut whole = Plane::filled(width, height, f32::NAN);
        for v in 0..plane.height() {
            let (u, width) = (maps.roi.u, plane.width());
            whole.row_mut(maps.roi.v + v)[u..u + width].copy_from_slice(plane.row(v));
        }
        file.add(array, &[height as u64, width as u64], whole.as_slice())?;
    }
    Ok(file.finish()?)
}
