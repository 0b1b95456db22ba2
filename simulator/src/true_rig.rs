// SPDX-License-Identifier: MIT OR Apache-2.0
//! The true geometry: the rig's nominal one, disturbed as a real build would be; and smaller copies of a rig.

use crate::random::Stream;
use crate::scenario::Jitter;
use fourdbody::config::Rig;
use fourdbody::data::{CalibratedCamera, CalibratedHead, Calibration, PanelRows};
use fourdbody::geometry::{Device, Lens, Pose};
use nalgebra::{Translation3, UnitQuaternion, Vector3};

/// The rig as it was when it was calibrated, for this seed.
pub fn true_calibration(rig: &Rig, jitter: &Jitter, seed: u64) -> Calibration {
    let heads = rig.heads.iter().map(|head| CalibratedHead {
        id: head.id.clone(),
        channel: head.channel,
        projector: disturbed(
            &head.projector,
            jitter,
            jitter.projector_distortion,
            &mut Stream::new(seed, &format!("projector {}", head.id)),
        ),
        rows: Some(PanelRows::exact()),
        cameras: head
            .cameras
            .iter()
            .map(|camera| CalibratedCamera {
                id: camera.id.clone(),
                device: disturbed(
                    &camera.device,
                    jitter,
                    jitter.camera_distortion,
                    &mut Stream::new(seed, &format!("camera {}", camera.id)),
                ),
            })
            .collect(),
    });
    Calibration::new(rig, format!("true geometry of the simulated rig, seed {seed}"), heads.collect())
}

/// The rig after its devices have turned about axes by lot: what photographs are taken with. The stated geometry stays
/// that of the calibration.
pub fn drifted(calibrated: &Calibration, drift_deg: f64, seed: u64) -> Calibration {
    let mut now = calibrated.clone();
    if drift_deg == 0.0 {
        return now;
    }
    for head in &mut now.heads {
        turn(&mut head.projector, drift_deg, &mut Stream::new(seed, &format!("drift projector {}", head.id)));
        for camera in &mut head.cameras {
            turn(
                &mut camera.device,
                drift_deg,
                &mut Stream::new(seed, &format!("drift camera {}", camera.id)),
            );
        }
    }
    now
}

/// Turns a device about its centre.
fn turn(device: &mut Device, rms_deg: f64, random: &mut Stream) {
    let each = rms_deg.to_radians() / 3f64.sqrt();
    let axis = Vector3::from_fn(|_, _| each * random.normal());
    let mut pose = *device.world_from_device.isometry();
    pose.rotation *= UnitQuaternion::from_scaled_axis(axis);
    device.world_from_device = Pose::new(pose);
}

fn disturbed(nominal: &Device, jitter: &Jitter, [k1, k2]: [f64; 2], random: &mut Stream) -> Device {
    let mut normals = |scale: f64| Vector3::from_fn(|_, _| scale * random.normal());
    let shift = normals(jitter.position_mm / 1000.0);
    let turn = UnitQuaternion::from_scaled_axis(normals(jitter.angle_deg.to_radians()));
    let centre = normals(jitter.centre_px);
    // fx and fy of one lens differ by the shape of its pixels only.
    let focal = normals(jitter.focal);
    let aspect = focal.y * 0.02;
    let radial = normals(jitter.distortion);
    let tangential = normals(jitter.tangential);
    let nominal_pose = nominal.world_from_device.isometry();
    let mut pose = *nominal_pose;
    pose.translation = Translation3::from(pose.translation.vector + shift);
    pose.rotation = nominal_pose.rotation * turn;
    let [n1, n2, n3, n4, n5] = nominal.lens.distortion;
    let lens = Lens {
        fx: nominal.lens.fx * (1.0 + focal.x),
        fy: nominal.lens.fy * (1.0 + focal.x + aspect),
        cx: nominal.lens.cx + centre.x,
        cy: nominal.lens.cy + centre.y,
        distortion: [
            n1 + k1 * (1.0 + radial.x),
            n2 + k2 * (1.0 + radial.y),
            n3 + tangential.x,
            n4 + tangential.y,
            n5,
        ],
    };
    Device { width: nominal.width, height: nominal.height, lens, world_from_device: Pose::new(pose) }
}

/// A device with `divisor` times fewer pixels along each side and the same view.
fn smaller_device(device: &Device, divisor: usize) -> Device {
    let k = divisor as f64;
    let centre = |c: f64| (c + 0.5) / k - 0.5;
    let lens = Lens {
        fx: device.lens.fx / k,
        fy: device.lens.fy / k,
        cx: centre(device.lens.cx),
        cy: centre(device.lens.cy),
        distortion: device.lens.distortion,
    };
    Device { width: device.width / divisor, height: device.height / divisor, lens, ..device.clone() }
}

/// The rig with `divisor` times fewer pixels along every side of cameras and panels. The fringe period stays
/// the same in pixels, so that images keep their character; there are fewer fringes.
pub fn smaller_rig(rig: &Rig, divisor: usize) -> Rig {
    let mut rig = rig.clone();
    if divisor <= 1 {
        return rig;
    }
    let index = f64::from(rig.pattern.marker_index) / divisor as f64;
    rig.pattern.marker_index = index.round() as u32;
    rig.pattern.marker_every = rig.pattern.marker_every.div_ceil(divisor as u32);
    for head in &mut rig.heads {
        head.projector = smaller_device(&head.projector, divisor);
        for camera in &mut head.cameras {
            camera.device = smaller_device(&camera.device, divisor);
        }
    }
    rig
}

/// The jitter that does the same to a smaller rig.
pub fn smaller_jitter(jitter: &Jitter, divisor: usize) -> Jitter {
    Jitter { centre_px: jitter.centre_px / divisor.max(1) as f64, ..jitter.clone() }
}

#[cfg(test)]
mod tests {
    use super::{smaller_rig, true_calibration};
    use crate::scenario::Scenario;
    use fourdbody::config::Rig;
    use nalgebra::Point3;
    use std::path::Path;

    fn shipped() -> (Rig, Scenario) {
        let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config");
        let scenario = Scenario::load(&config.join("scenarios/demo.toml")).expect("valid");
        (Rig::load(&scenario.rig).expect("valid"), scenario)
    }

    #[test]
    fn the_true_rig_is_near_the_nominal_one_and_differs_by_seed() {
        let (rig, scenario) = shipped();
        let truth = true_calibration(&rig, &scenario.geometry, 7);
        let middle = Point3::new(0.0, 0.0, 1.0);
        for ((_, nominal), (_, real)) in rig.cameras().zip(truth.cameras()) {
            let off = (nominal.device.centre() - real.device.centre()).norm();
            assert!((1e-4..0.04).contains(&off), "{off}");
            let pixel = real.device.project(&middle).expect("in view");
            assert!((pixel[0] - 959.5).hypot(pixel[1] - 599.5) < 150.0, "{pixel:?}");
        }
        assert_eq!(truth, true_calibration(&rig, &scenario.geometry, 7));
        assert_ne!(truth, true_calibration(&rig, &scenario.geometry, 8));
    }

    #[test]
    fn a_smaller_rig_sees_the_same() {
        let (rig, _) = shipped();
        let small = smaller_rig(&rig, 4);
        let point = Point3::new(0.1, 0.2, 1.4);
        let (a, b) = (&rig.heads[0].cameras[0].device, &small.heads[0].cameras[0].device);
        let (p, q) = (a.project(&point).expect("in view"), b.project(&point).expect("in view"));
        assert!(((p[0] + 0.5) / 4.0 - 0.5 - q[0]).abs() < 1e-9);
        assert_eq!((b.width, b.height), (480, 300));
    }
}
