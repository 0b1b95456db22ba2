// SPDX-License-Identifier: MIT OR Apache-2.0
//! A calibration against the true rig: where the points of the working volume end up.
//!
//! For a grid of pixels and distances of every camera, the true devices give the panel column that lights the true
//! point; the calibration under test turns pixel and column into a point of its own. A calibration's world is its own
//! choice, so the points are compared after the rigid motion that fits them best: head by head (the heads' own errors),
//! and all together (how the heads stand to each other, too).

use fourdbody::base::ids::HeadId;
use fourdbody::data::Calibration;
use fourdbody::geometry::{Device, Pose, best_motion};
use fourdbody::reconstruct::triangulate::camera_projector::CameraProjector;
use fourdbody::reconstruct::triangulate::triangulator::Triangulator;
use nalgebra::{Isometry3, Point3, Vector3};

/// Pixels between rays, and metres between the points along one.
const STEP_PX: usize = 97;
const STEP_M: f64 = 0.15;

/// Distances between where points are and where the calibration puts them.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Distances {
    pub points: usize,
    pub rms_mm: f64,
    pub max_mm: f64,
}

/// A calibration against the truth.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Comparison {
    /// Each head after its own best motion.
    pub heads: Vec<(HeadId, Distances)>,
    /// All heads after one motion.
    pub together: Distances,
    /// Angle between the two worlds' vertical axes.
    pub tilt_deg: f64,
    /// How far the motion moves the middle of the volume.
    pub shift_mm: f64,
    /// The motion: takes the calibration's world to the true one.
    #[serde(skip)]
    pub true_from_found: Isometry3<f64>,
}

/// A point as the calibration has it, and as it is.
type Both = (Point3<f64>, Point3<f64>);

/// Compares a calibration with the true geometry of the same cameras.
pub fn compare(found: &Calibration, truth: &Calibration) -> Result<Comparison, String> {
    let mut heads = Vec::new();
    let mut all: Vec<Both> = Vec::new();
    for head in &truth.heads {
        let points = head_points(head.id.as_str(), found, truth)?;
        heads.push((head.id.clone(), distances(&points, &fitted(&points)?)));
        all.extend(points);
    }
    let true_from_found = fitted(&all)?;
    let up = true_from_found.rotation * Vector3::z();
    let [low, high] = [truth.volume_min_m, truth.volume_max_m].map(Vector3::from);
    let middle = Point3::from((low + high) / 2.0);
    Ok(Comparison {
        heads,
        together: distances(&all, &true_from_found),
        tilt_deg: up.angle(&Vector3::z()).to_degrees(),
        shift_mm: 1e3 * (true_from_found * middle - middle).norm(),
        true_from_found,
    })
}

/// The calibration moved as a whole, into another world.
pub fn moved(calibration: &Calibration, motion: &Isometry3<f64>) -> Calibration {
    let mut moved = calibration.clone();
    let move_device = |device: &mut Device| {
        device.world_from_device = Pose::new(motion * device.world_from_device.isometry())
    };
    for head in &mut moved.heads {
        move_device(&mut head.projector);
        head.cameras.iter_mut().for_each(|camera| move_device(&mut camera.device));
    }
    moved.origin = format!("{}; moved into another world frame", moved.origin);
    moved
}

fn head_points(head: &str, found: &Calibration, truth: &Calibration) -> Result<Vec<Both>, String> {
    let of = |calibration: &'_ Calibration| calibration.heads.iter().position(|h| h.id.as_str() == head);
    let (Some(f), Some(t)) = (of(found), of(truth)) else {
        return Err(format!("head {head} is not in both calibrations"));
    };
    let (found_head, true_head) = (&found.heads[f], &truth.heads[t]);
    let mut points = Vec::new();
    for camera in &true_head.cameras {
        let Some(same) = found_head.cameras.iter().find(|c| c.id == camera.id) else {
            return Err(format!("camera {} is not in both calibrations", camera.id));
        };
        let triangulator = Triangulator::new(CameraProjector::new(found_head, same, found)?);
        let device = &camera.device;
        let pixels = (0..device.height)
            .step_by(STEP_PX.min(device.height / 8 + 1))
            .flat_map(|v| (0..device.width).step_by(STEP_PX.min(device.width / 12 + 1)).map(move |u| (u, v)));
        for (u, v) in pixels {
            let Some(ray) = device.ray(u as f64, v as f64) else { continue };
            for step in 0..40 {
                let point = ray.at(f64::from(step) * STEP_M);
                let inside =
                    (0..3).all(|a| (truth.volume_min_m[a]..truth.volume_max_m[a]).contains(&point[a]));
                let panel = true_head.projector.project(&point).filter(|p| true_head.projector.contains(*p));
                let Some([column, _]) = panel.filter(|_| inside) else { continue };
                let phase = truth.pattern.phase(column);
                points.extend(triangulator.point(u, v, phase).map(|(_, world)| (world, point)));
            }
        }
    }
    Ok(points)
}

/// The rigid motion that fits best.
fn fitted(points: &[Both]) -> Result<Isometry3<f64>, String> {
    best_motion(points).ok_or_else(|| {
        format!("{} points of the volume are seen by both calibrations, expected many", points.len())
    })
}

fn distances(points: &[Both], motion: &Isometry3<f64>) -> Distances {
    let mut sum = 0.0;
    let mut max: f64 = 0.0;
    for (found, truth) in points {
        let distance = (motion * found - truth).norm();
        sum += distance * distance;
        max = max.max(distance);
    }
    let rms = (sum / points.len().max(1) as f64).sqrt();
    Distances { points: points.len(), rms_mm: 1e3 * rms, max_mm: 1e3 * max }
}

#[cfg(test)]
mod tests {
    use super::{compare, moved};
    use fourdbody::config::Rig;
    use fourdbody::data::Calibration;
    use nalgebra::{Isometry3, Vector3};
    use std::path::Path;

    fn nominal() -> Calibration {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/rig.toml");
        Calibration::nominal(&Rig::load(&path).expect("the shipped rig"))
    }

    #[test]
    fn another_world_is_no_difference_and_another_lens_is() {
        let truth = nominal();
        let motion = Isometry3::new(Vector3::new(0.01, -0.02, 0.005), Vector3::new(0.01, 0.0, 0.0));
        let found = moved(&truth, &motion);
        let same = compare(&found, &truth).expect("comparable");
        assert!(same.together.max_mm < 0.02, "{same:?}");
        assert!((same.tilt_deg - 0.01f64.to_degrees()).abs() < 1e-3, "{same:?}");
        let back = compare(&moved(&found, &same.true_from_found), &truth).expect("comparable");
        assert!(back.shift_mm < 0.01 && back.tilt_deg < 1e-3, "{back:?}");

        let mut wrong = truth.clone();
        wrong.heads[1].cameras[0].device.lens.fx *= 1.001;
        let wrong = compare(&wrong, &truth).expect("comparable");
        assert!(wrong.heads[0].1.max_mm < 0.02 && wrong.heads[1].1.rms_mm > 0.1, "{wrong:?}");

        let mut fewer = truth.clone();
        fewer.heads.truncate(2);
        assert!(compare(&fewer, &truth).is_err());
    }
}
