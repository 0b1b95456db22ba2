// SPDX-License-Identifier: MIT OR Apache-2.0
//! What comes after the phase, on a wall rendered here by direct formula: uncertainties against actual errors, and
//! clouds made of stored phase maps against those written directly.

use fourdbody::base::ids::{CameraId, TriggerIndex};
use fourdbody::base::image::{Mono8, Plane};
use fourdbody::batch::from_phase_maps;
use fourdbody::batch::run::{self, Format, Plan};
use fourdbody::config::Rig;
use fourdbody::data::{Calibration, Frame, FrameSource};
use fourdbody::geometry::Device;
use fourdbody::geometry::pattern::Pattern;
use fourdbody::reconstruct::pipeline::{Method, Pipeline};
use fourdbody::reconstruct::triangulate::camera_projector::CameraProjector;
use fourdbody::reconstruct::triangulate::triangulator::Triangulator;
use nalgebra::{Point3, Vector3};
use std::ops::Range;
use std::path::Path;

pub fn calibration() -> Calibration {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
    Calibration::nominal(&Rig::load(&path).expect("the shipped rig"))
}

const ORIGIN: Point3<f64> = Point3::new(0.0, 0.0, 1.0);

fn wall_normal() -> Vector3<f64> {
    Vector3::new(0.93, 0.25, 0.1).normalize()
}

/// Reflectance of the wall: fields beside each other.
const PAINT: [f64; 4] = [1.0, 0.5, 0.25, 0.12];

fn field(y: f64) -> usize {
    (((y + 0.3) / 0.15).max(0.0) as usize).min(PAINT.len() - 1)
}

/// A frame of the wall by a sensor of 40 electrons per DN with a read noise of 0.5 DN.
fn photograph(camera: &Device, projector: &Device, pattern: &Pattern) -> Plane<u8> {
    let mut image = Plane::filled(camera.width, camera.height, 2u8);
    let (normal, mut state) = (wall_normal(), 1u64);
    let mut draw = || {
        // Twelve even numbers: nearly a normal one.
        let mut even = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f64 / (1u64 << 24) as f64
        };
        (0..12).map(|_| even()).sum::<f64>() - 6.0
    };
    for v in 300..900 {
        for u in 400..1500 {
            let Some(ray) = camera.ray(u as f64, v as f64) else { continue };
            let point = ray.at((ORIGIN - ray.origin).dot(&normal) / ray.direction.dot(&normal));
            let panel = projector.project(&point).filter(|panel| projector.contains(*panel));
            let inside = (point.z - 1.0).abs() < 0.3 && point.y.abs() < 0.3;
            let Some([pu, pv]) = panel.filter(|_| inside) else { continue };
            let light = 2.0 + 190.0 * PAINT[field(point.y)] * pattern.light(pu, pv);
            let noisy = light + draw() * (light / 40.0 + 0.25).sqrt();
            image.set(u, v, noisy.round().clamp(0.0, 255.0) as u8);
        }
    }
    image
}

#[test]
fn the_uncertainty_is_that_of_the_points() {
    let calibration = calibration();
    let head = &calibration.heads[0];
    let pair = CameraProjector::new(head, &head.cameras[0], &calibration).expect("a usable pair");
    let image = photograph(&pair.camera, &pair.projector, &pair.pattern);
    let centre = pair.camera.centre();
    let pipeline = Pipeline::new(Triangulator::new(pair), Method::Joint, false).with_uncertainty(true);
    let cloud = pipeline.run(Mono8::from(&image)).cloud;
    assert!(cloud.len() > 80_000 && cloud.sigma_m.len() == cloud.len(), "{} points", cloud.len());
    let mut ratios = PAINT.map(|_| Vec::new());
    for (p, sigma) in cloud.position_m.iter().zip(&cloud.sigma_m) {
        let point = Point3::from(*p).cast::<f64>();
        let sight = (point - centre).normalize();
        let error = (point - ORIGIN).dot(&wall_normal()) / sight.dot(&wall_normal());
        ratios[field(point.y)].push(error.abs() / f64::from(*sigma));
    }
    for (mut ratios, paint) in ratios.into_iter().zip(PAINT) {
        ratios.sort_by(f64::total_cmp);
        let ratio = 1.4826 * ratios[ratios.len() / 2];
        println!("reflectance {paint}: {} points, actual over predicted {ratio:.2}", ratios.len());
        assert!(ratios.len() > 10_000 && (0.6..1.2).contains(&ratio), "{paint}: {ratio}");
    }
}

/// Frames of some cameras; others have gaps.
pub struct Frames(pub Vec<(CameraId, Option<Plane<u8>>)>, pub Vec<CameraId>);

impl FrameSource for Frames {
    fn cameras(&self) -> &[CameraId] {
        &self.1
    }

    fn triggers(&self) -> Range<u64> {
        0..1
    }

    fn frame(&self, camera: &CameraId, _: TriggerIndex) -> Result<Frame<'_>, String> {
        let frame = self.0.iter().find(|(id, _)| id == camera).and_then(|(_, frame)| frame.as_ref());
        Ok(frame.map_or(Frame::Gap("unplugged".to_owned()), |image| Frame::Image(Mono8::from(image))))
    }

    fn trigger_time_ns(&self, _: TriggerIndex) -> Option<u64> {
        Some(1_234_567_890_123)
    }
}

#[test]
fn clouds_of_stored_phase_have_the_bytes_of_those_written_directly() {
    let calibration = calibration();
    let cameras: Vec<CameraId> = calibration.cameras().take(4).map(|(_, camera)| camera.id.clone()).collect();
    let head = &calibration.heads[0];
    let frame = |i: usize| photograph(&head.cameras[i].device, &head.projector, &calibration.pattern);
    // Two photographs, one black frame, which is refused, and a gap.
    let black = Plane::filled(1920, 1200, 2u8);
    let frames = [Some(frame(0)), Some(frame(1)), Some(black), None];
    let source = Frames(cameras.iter().cloned().zip(frames).collect(), cameras.clone());
    let dir = tempfile::tempdir().expect("a temporary directory");
    for uncertainty in [false, true] {
        let out = |name: &str| dir.path().join(format!("{name}-{uncertainty}"));
        let run = |name: &str, format| {
            let cameras = cameras.clone();
            let (out, formats) = (out(name), vec![format]);
            let plan = Plan { out, triggers: 0..1, cameras, formats, uncertainty, ..Plan::default() };
            let (summary, _) = run::run(&source, &calibration, &plan, run::to_the_end).expect("runs");
            if format == Format::Ply {
                run::write_sequence(&plan, &summary, 120.0).expect("writable");
            }
            summary
        };
        // Of phase maps nothing is merged before they are exported; all else is the same.
        let mut direct = run("direct", Format::Ply);
        assert_eq!(direct.merged_points.take(), Some(direct.points()), "one head alone leaves nothing out");
        direct.triggers.iter_mut().for_each(|trigger| trigger.merged_points = None);
        assert_eq!(direct, run("stored", Format::Phase));
        assert_eq!(direct, run("stored", Format::Phase), "what is finished is kept");
        let export = || from_phase_maps::export(&out("stored"), &calibration, &out("made"), 120.0, |_, _| ());
        assert_eq!(export().expect("exports").kept, 0);
        // What is cut is made again, what is whole is kept.
        let cloud = out("made").join(format!("clouds/{}_000000.ply", cameras[1]));
        let whole = std::fs::read(&cloud).expect("was written");
        std::fs::write(&cloud, &whole[..whole.len() - 1]).expect("writable");
        assert_eq!(export().expect("exports").kept, 0);
        assert_eq!(export().expect("exports").kept, 1);
        let mut files = vec!["merged/000000.ply".to_owned(), "sequence.mcap".to_owned()];
        files.extend(cameras[..3].iter().map(|camera| format!("clouds/{camera}_000000.ply")));
        for file in files {
            let read = |name: &str| std::fs::read(out(name).join(&file)).expect("was written");
            assert!(read("direct") == read("made"), "{file} differs");
        }
        let size = |name: &str, folder: &str| -> u64 {
            let files = std::fs::read_dir(out(name).join(folder)).expect("a directory");
            files.map(|file| file.and_then(|file| file.metadata()).expect("a file").len()).sum()
        };
        let (small, large) = (size("stored", "phases"), size("direct", "clouds"));
        println!("phase maps {small} bytes, clouds {large}");
        assert!(small * 10 < large);
    }

    let stored = dir.path().join("stored-false");
    let refused = |calibration: &Calibration, words: &str| {
        let error = from_phase_maps::export(&stored, calibration, &dir.path().join("none"), 120.0, |_, _| ());
        let error = error.expect_err("must be refused").to_string();
        assert!(error.contains(words), "{error}");
    };
    let mut other = calibration.clone();
    other.heads[0].projector.lens.fx += 0.01;
    refused(&other, "calibration");
    let mut other = calibration.clone();
    other.volume_max_m[2] += 0.01;
    refused(&other, "calibration");
    let path = fourdbody::batch::files::phase_path(&stored, cameras[0].as_str(), 0);
    let mut bytes = std::fs::read(&path).expect("was written");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    std::fs::write(&path, bytes).expect("writable");
    refused(&calibration, "checksum");
}
