//! The reconstruction of one photograph, by a calibration of which numbers have been changed.

use super::Script;
use fourdbody::calibrate::Calibration;
use fourdbody::config::Rig;
use fourdbody::image::{Mono8, Plane};
use fourdbody::reconstruct::pair::Pair;
use fourdbody::reconstruct::pipeline::{Method, Outcome, Pipeline, Reconstruction};
use fourdbody::reconstruct::triangulate::Triangulator;
use std::path::PathBuf;
use std::sync::OnceLock;
use tempfile::TempDir;

/// Size of the camera: a part of the shipped rig's, around the volume's middle, with the same fringes.
const SIZE: (usize, usize) = (192, 72);

thread_local! {
    static DIRECTORY: TempDir =
        tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).expect("a directory");
}

/// The shipped rig's first head with one small camera.
fn calibration() -> Calibration {
    let table = include_str!("../../config/rig.toml").parse().expect("TOML");
    let mut calibration = Calibration::nominal(&Rig::from_table(&table).expect("the shipped rig"));
    calibration.heads.truncate(1);
    calibration.heads[0].cameras.truncate(1);
    let camera = &mut calibration.heads[0].cameras[0].device;
    camera.lens.cx -= (camera.width - SIZE.0) as f64 / 2.0;
    camera.lens.cy -= (camera.height - SIZE.1) as f64 / 2.0;
    (camera.width, camera.height) = SIZE;
    calibration
}

/// A wall in the middle of the volume, lit by the pattern.
fn good_frame() -> &'static Plane<u8> {
    static FRAME: OnceLock<Plane<u8>> = OnceLock::new();
    FRAME.get_or_init(|| {
        let calibration = calibration();
        let (head, camera) = calibration.cameras().next().expect("a camera");
        let mut image = Plane::filled(SIZE.0, SIZE.1, 2u8);
        for v in 6..SIZE.1 - 6 {
            for u in 12..SIZE.0 - 12 {
                let seen = camera.device.ray(u as f64, v as f64).and_then(|ray| {
                    // The wall x = 0.05.
                    let point = ray.at((0.05 - ray.origin.x) / ray.direction.x);
                    head.projector.project(&point)
                });
                if let Some([u_p, v_p]) = seen {
                    image.set(u, v, (3.0 + 200.0 * calibration.pattern.light(u_p, v_p)).round() as u8);
                }
            }
        }
        image
    })
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

/// Changes the frame: a rectangle set to one value, brighter, darker, noisy, or taken from the fuzzer's bytes.
fn change_frame(image: &mut Plane<u8>, script: &mut Script<'_>) -> Option<()> {
    let (kind, value) = (script.byte()?, script.byte()?);
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

/// A script: how many numbers of the calibration are changed, which and how; then changes of the frame.
///
/// Holds: a calibration that its file's reader accepts is refused with words or used; what comes of the frame is a cloud of
/// finite points within the volume, with unit normals, at pixels of the frame, or a refusal with words and without points.
pub fn photograph(data: &[u8]) {
    let mut script = Script(data);
    let (Some(first), mut calibration) = (script.byte(), calibration()) else { return };
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
    let (head, camera) = calibration.cameras().next().expect("one camera");
    let pair = match Pair::new(head, camera, &calibration) {
        Ok(pair) => pair,
        Err(why) => return assert!(!why.is_empty()),
    };
    let mut image = good_frame().clone();
    while change_frame(&mut image, &mut script).is_some() {}
    let method = if first & 0x80 == 0 { Method::Anchored } else { Method::Paper };
    let volume = [pair.volume_min_m, pair.volume_max_m];
    let found = Pipeline::new(Triangulator::new(pair), method, first & 0x40 != 0).run(Mono8::from(&image));
    hold(&found, volume);
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
