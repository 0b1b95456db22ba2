// SPDX-License-Identifier: MIT OR Apache-2.0
//! How a projector's fringes lie in a camera's image, by the geometry of the two.

use super::Device;
use super::pattern::Pattern;
use nalgebra::Point3;

/// Fringes on a plane that faces the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fringes {
    /// +1 where the absolute phase grows with the image column, -1 where it falls.
    pub sign: f64,
    /// Their period along the image columns, px.
    pub period_px: f64,
    /// Period of the marker's modulation along the image rows, px.
    pub marker_period_px: f64,
}

/// Fringe periods of which the phase can be found, px.
const PERIOD_PX: (f64, f64) = (4.0, 40.0);
/// Periods of the marker that its filter can have, px: the filter is one period long.
const MARKER_PERIOD_PX: (f64, f64) = (2.0, 200.0);

impl Fringes {
    /// The fringes as a camera sees them at `middle`, world, m.
    ///
    /// # Errors
    /// They are not seen there, or not in a form of which the phase can be found.
    pub fn seen_by(
        camera: &Device,
        projector: &Device,
        pattern: &Pattern,
        middle: &Point3<f64>,
    ) -> Result<Self, String> {
        const UNSEEN: &str = "camera and projector do not both see the middle of the volume; check position_m and \
                              look_at_m of the two";
        let (across, along) = panel_steps(camera, projector, middle).ok_or(UNSEEN)?;
        let column = across[0].abs();
        // Where fringes run along the columns their period across them has no meaning.
        if column <= across[1].abs() {
            return Err(format!(
                "the fringes run along the image columns, expected them across: a step of one image column \
                 is {column:.2} \
                 px on the panel across the fringes, one of one row {:.2} px; check roll_deg of camera and projector",
                along[0].abs()
            ));
        }
        // Else the surface moves along the fringes when it moves away, so that its distance does not show in them.
        let [by_depth, beside] = depth_steps(camera, projector, middle).ok_or(UNSEEN)?;
        if by_depth.abs() <= beside.abs() {
            let message = "the fringes run along the line from camera to projector, expected them across \
                 it: the distance \
                           of what they light does not move them; check roll_deg and position_m of the two";
            return Err(message.to_owned());
        }
        let period_px = pattern.period_px / column;
        if !(PERIOD_PX.0..=PERIOD_PX.1).contains(&period_px) {
            let (least, most) = PERIOD_PX;
            return Err(format!(
                "expected fringes with a period of {least} to {most} px in the image, found {period_px:.1} px; check \
                 period_px of the pattern, focal_px and the distance"
            ));
        }
        let marker_period_px = pattern.marker_period_px / along[1].abs().max(1e-3);
        if !(MARKER_PERIOD_PX.0..=MARKER_PERIOD_PX.1).contains(&marker_period_px) {
            let (least, most) = MARKER_PERIOD_PX;
            return Err(format!(
                "expected a marker that changes along itself with a period of {least} to {most} px in the image, found \
                 {marker_period_px:.1} px; check the pattern's marker_period_px"
            ));
        }
        Ok(Self { sign: across[0].signum(), period_px, marker_period_px })
    }
}

/// Panel steps (u, v) of one image column and of one image row, on the plane through `middle` that faces the
/// camera.
fn panel_steps(camera: &Device, projector: &Device, middle: &Point3<f64>) -> Option<([f64; 2], [f64; 2])> {
    let [u, v] = camera.project(middle)?;
    let depth = camera.device_point(middle).z;
    let panel = |u: f64, v: f64| {
        let [x, y] = camera.lens.undistort(u, v)?;
        let point = Point3::new(x * depth, y * depth, depth);
        projector.project(&camera.world_from_device.isometry().transform_point(&point))
    };
    let step = |a: [f64; 2], b: [f64; 2]| [(b[0] - a[0]) / 8.0, (b[1] - a[1]) / 8.0];
    let across = step(panel(u - 4.0, v)?, panel(u + 4.0, v)?);
    let along = step(panel(u, v - 4.0)?, panel(u, v + 4.0)?);
    Some((across, along))
}

/// Panel steps (u, v) of a surface that moves away from the camera along its ray through `middle`, per metre.
fn depth_steps(camera: &Device, projector: &Device, middle: &Point3<f64>) -> Option<[f64; 2]> {
    const STEP_M: f64 = 0.01;
    let ray = (middle - camera.centre()).try_normalize(1e-9)?;
    let near = projector.project(&(middle - ray * STEP_M))?;
    let far = projector.project(&(middle + ray * STEP_M))?;
    Some([far[0] - near[0], far[1] - near[1]].map(|step| step / (2.0 * STEP_M)))
}
