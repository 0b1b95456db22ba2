// SPDX-License-Identifier: MIT OR Apache-2.0
//! The reconstruction of photographs, one alone and three of one instant, by a calibration of which numbers have been changed.

use super::Script;
use fourdbody::base::image::{Mono8, Plane};
use fourdbody::config::Rig;
use fourdbody::data::{Calibration, PanelRows};
use fourdbody::geometry::Device;
use fourdbody::geometry::pattern::Pattern;
use fourdbody::reconstruct::frame_set::{self, Camera};
use fourdbody::reconstruct::fringe_order::MostDifference;
use fourdbody::reconstruct::outcome::{Outcome, Reconstruction};
use fourdbody::reconstruct::pipeline::{Method, Pipeline};
use fourdbody::reconstruct::triangulate::camera_projector::CameraProjector;
use fourdbody::reconstruct::triangulate::triangulator::Triangulator;
use std::path::PathBuf;
use std::sync::OnceLock;
use tempfile::TempDir;

/// Size of the cameras: parts of the shipped rig's, around the volume's middle, with the same fringes.
const SIZE: (usize, usize) = (192, 72);

thread_local! {
    static DIRECTORY: TempDir =
        tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).expect("a directory");
}

/// Cameras: both of one head, and one of its neighbour.
const CAMERAS: usize = 3;

/// The column that they see, around the volume's axis, m.
const RADIUS_M: f64 = 0.12;

/// The shipped rig's first two heads with three small cameras.
fn calibration() -> Calibration {
    let table = include_str!("../../config/rig.toml").parse().expect("TOML");
    let mut calibration = Calibration::nominal(&Rig::from_table(&table).expect("the shipped rig"));
    calibration.heads.truncate(2);
    calibration.heads[1].cameras.truncate(CAMERAS - 2);
    for camera in calibration.heads.iter_mut().flat_map(|head| &mut head.cameras) {
        let camera = &mut camera.device;
        camera.lens.cx -= (camera.width - SIZE.0) as f64 / 2.0;
        camera.lens.cy -= (camera.height - SIZE.1) as f64 / 2.0;
        (camera.width, camera.height) = SIZE;
    }
    calibration
}

/// A round column in the middle of the volume, lit by the pattern, as each camera sees it.
fn good_frames() -> &'static [Plane<u8>] {
    static FRAMES: OnceLock<Vec<Plane<u8>>> = OnceLock::new();
    FRAMES.get_or_init(|| {
        let calibration = calibration();
        let cameras = calibration.cameras();
        cameras.map(|(head, camera)| frame(&camera.device, &head.projector, &calibration.pattern)).collect()
    })
}

fn frame(camera: &Device, projector: &Device, pattern: &Pattern) -> Plane<u8> {
    let mut image = Plane::filled(SIZE.0, SIZE.1, 2u8);
    for v in 6..SIZE.1 - 6 {
        for u in 12..SIZE.0 - 12 {
            let seen = camera.ray(u as f64, v as f64).and_then(|ray| {
                // Seen from above the column is a circle.
                let (from, along) = (ray.origin.coords.xy(), ray.direction.xy());
                let (nearest, length) = (-from.dot(&along) / along.norm_squared(), along.norm());
                let aside = (from + along * nearest).norm_squared();
                let half = (RADIUS_M * RADIUS_M - aside).max(0.0).sqrt() / length;
                (half > 0.0).then(|| projector.project(&ray.at(nearest - half))).flatten()
            });
            if let Some([u_p, v_p]) = seen {
                image.set(u, v, (3.0 + 200.0 * pattern.light(u_p, v_p)).round() as u8);
            }
        }
    }
    image
}

/// Every number of a calibration that a photograph's reconstruction depends on.
fn numbers(calibration: &mut Calibration) -> Vec<&mut f64> {
    let head = &mut calibration.heads[0];
    let mut all = Vec::new();
    for lens in [&mut head.cameras[0].device.lens, &mut head.projector.lens] {
        all.extend([&mut lens.fx, &mut lens.fy, &mut lens.cx, &mut lens.cy]);
        all.extend(lens.distortion.iter_mut());
    }
    let pattern = &mut calibration.pattern;
    all.extend([&mut pattern.period_px, &mut pattern.marker_period_px, &mut pattern.low, &mut pattern.high]);
    all.push(&mut pattern.gamma);
    all.extend(calibration.volume_min_m.iter_mut());
    all.extend(calibration.volume_max_m.iter_mut());
    all
}

fn changed_number(old: f64, how: u8, by: u16) -> f64 {
    let share = f64::from(by) / 65_536.0;
    match how % 10 {
        0 => f64::NAN,
        1 => f64::INFINITY,
        2 => 0.0,
        3 => -old,
        4 => old * 1e300,
        5 => old * 1e-300,
        6 => old * (0.5 + share),
        7 => old + share - 0.5,
        8 => old * (1.0 + 0.01 * (share - 0.5)),
        _ => 1000.0 * (share - 0.5),
    }
}

/// Changes a frame: a rectangle set to one value, brighter, darker, noisy, or taken from the fuzzer's bytes.
fn change_frame(images: &mut [Plane<u8>], script: &mut Script<'_>) -> Option<()> {
    let (kind, value) = (script.byte()?, script.byte()?);
    let image = &mut images[usize::from(kind / 5) % CAMERAS];
    let (u, v) = (usize::from(script.byte()?) % SIZE.0, usize::from(script.byte()?) % SIZE.1);
    let (width, height) = (usize::from(script.byte()?), usize::from(script.byte()?));
    for y in v..(v + height).min(SIZE.1) {
        for x in u..(u + width).min(SIZE.0) {
            let old = image.at(x, y);
            let new = match kind % 5 {
                0 => value,
                1 => old.saturating_mul(value % 8),
                2 => old / (value | 1),
                3 => old.wrapping_add((x.wrapping_mul(151) ^ y.wrapping_mul(57)) as u8 % (value | 1)),
                _ => script.byte()?,
            };
            image.set(x, y, new);
        }
    }
    Some(())
}

/// A script: whether the calibration knows the panel's rows, and how many of its numbers are changed, which and how; then changes of the frames.
///
/// Holds: a calibration that its file's reader accepts is refused with words or used; what comes of a frame is a cloud of
/// finite points within the volume, with unit normals, at pixels of the frame, or a refusal with words and without points.
pub fn photograph(data: &[u8]) {
    let mut script = Script(data);
    let (Some(first), mut calibration) = (script.byte(), calibration()) else { return };
    if first & 0x20 != 0 {
        calibration.heads.iter_mut().for_each(|head| head.rows = Some(PanelRows::exact()));
    }
    for _ in 0..first % 4 {
        let (Some(which), Some(how), Some(by)) = (script.byte(), script.byte(), script.word()) else {
            return;
        };
        let mut all = numbers(&mut calibration);
        let at = usize::from(which) % all.len();
        *all[at] = changed_number(*all[at], how, by);
    }
    let path: PathBuf = DIRECTORY.with(|dir| dir.path().join("calibration.json"));
    calibration.save(&path).expect("writable");
    let Ok(calibration) = Calibration::load(&path).map_err(|error| assert!(!error.to_string().is_empty()))
    else {
        return;
    };
    let mut images = good_frames().to_vec();
    while change_frame(&mut images, &mut script).is_some() {}
    if first & 0x80 == 0 {
        reconstruct(&calibration, &images, Method::Joint, first & 0x40 != 0, data.len() > 1);
    } else {
        reconstruct(&calibration, &images, Method::Paper, first & 0x40 != 0, true);
    }
}

/// One frame by itself, and those of one instant together. What is not `changed` has to become clouds.
fn reconstruct(
    calibration: &Calibration,
    images: &[Plane<u8>],
    method: Method,
    keep_maps: bool,
    changed: bool,
) {
    let mut pipelines = Vec::new();
    for (head, camera) in calibration.cameras() {
        match CameraProjector::new(head, camera, calibration) {
            Ok(pair) => pipelines.push(Pipeline::new(Triangulator::new(pair), method, keep_maps)),
            Err(why) => return assert!(!why.is_empty()),
        }
    }
    // A little more than the calibration's, and the same for all.
    let pair = pipelines[0].triangulator().pair();
    let volume = [pair.volume_min_m, pair.volume_max_m];
    hold(&pipelines[0].run(Mono8::from(&images[0])), volume);
    if method != Method::Paper {
        let found = together(&pipelines, images);
        found.iter().for_each(|found| hold(found, volume));
        // Unchanged at least one is borne out by a marker or another head: else the fuzzer would see refusals only. So small
        // a part of a round column looks much the same one fringe off.
        assert!(changed || found.iter().any(|found| found.outcome == Outcome::Cloud));
    }
}

/// The clouds of photographs of one instant.
fn together(pipelines: &[Pipeline], images: &[Plane<u8>]) -> Vec<Reconstruction> {
    let cameras =
        pipelines.iter().zip([0, 0, 1]).map(|(pipeline, head)| Camera { id: "a camera", head, pipeline });
    let photograph = |camera: usize| Some(Mono8::from(&images[camera]));
    frame_set::reconstruct(&cameras.collect::<Vec<_>>(), photograph, MostDifference::of_rows(1))
        .into_iter()
        .flatten()
        .collect()
}

fn hold(found: &Reconstruction, [min, max]: [[f64; 3]; 2]) {
    let cloud = &found.cloud;
    let count = cloud.len();
    assert_eq!([cloud.normal.len(), cloud.intensity.len(), cloud.pixel.len()], [count; 3]);
    if let Outcome::Refused(why) = &found.outcome {
        assert!(!why.is_empty() && count == 0);
    } else {
        assert!(count > 0);
    }
    for i in 0..count {
        let (p, n, [u, v]) = (cloud.position_m[i], cloud.normal[i], cloud.pixel[i]);
        // World coordinates are rounded after the test against the volume.
        let inside = (0..3).all(|k| (min[k] - 1e-4..=max[k] + 1e-4).contains(&f64::from(p[k])));
        assert!(inside, "{p:?} is outside {min:?} {max:?}");
        let length = n.iter().map(|x| x * x).sum::<f32>();
        assert!((length - 1.0).abs() < 1e-3, "normal {n:?}");
        assert!((0.0..=1.0).contains(&cloud.intensity[i]));
        assert!(usize::from(u) < SIZE.0 && usize::from(v) < SIZE.1);
    }
}
