// SPDX-License-Identifier: MIT OR Apache-2.0
//! Fits one device alone to the columns at which it sees points of known places. The fit is coarse, and tolerates views
//! that are some fringes off.

use super::observe::{linearize, project};
use super::{DEVICE_PARAMETERS, DeviceModel, Model, Observation, moved};
use crate::estimate::median;
use nalgebra::{DVector, Isometry3, Point3, SMatrix, SVector};

/// How far off the focal length may be in a rig file, as a share of it.
const FOCAL: f64 = 0.03;
/// How far off the principal point's column may be, px.
const CENTRE_PX: f64 = 20.0;
/// How far off the first radial term may be: a rig file may have lenses without distortion.
const RADIAL: f64 = 0.1;
/// How far off each angle may be, rad.
const TURN: f64 = 0.05;
/// How far off the place may be, across and along the view, m. Columns do not determine the third shift: it is held.
const SHIFT_M: f64 = 0.05;
/// Rounds of least squares, each with weights from the residuals that the last one left.
const ROUNDS: usize = 8;
/// How well a column is known at best, px: the fit is only to find whole fringes.
const LEAST_PX: f64 = 0.05;

/// A point of the common frame, m, and the column at which it is seen, px.
pub type SeenColumn = (Point3<f64>, f64);

/// Predicted minus seen column, px; NaN behind the device.
pub fn column_error(device: &DeviceModel, (point, column): &SeenColumn) -> f64 {
    project(device, &Isometry3::identity(), point).map_or(f64::NAN, |[u, _]| u - column)
}

fn observation(point: Point3<f64>, column: f64) -> Observation {
    Observation { device: 0, board: 0, point, measured: [column, 0.0], sigma_px: 1.0, columns_only: true }
}

/// The device near `start` that explains most columns best (Cauchy's weights); `start` itself without any.
pub fn fit_columns(start: &DeviceModel, seen: &[SeenColumn]) -> DeviceModel {
    let mut off = [0.0; DEVICE_PARAMETERS];
    off[0] = FOCAL * start.lens.fx;
    off[2] = CENTRE_PX;
    off[4] = RADIAL;
    off[9..12].fill(TURN);
    (off[12], off[14]) = (SHIFT_M, SHIFT_M);
    let free: Vec<Option<usize>> = (0..DEVICE_PARAMETERS).map(Some).collect();
    let first = Model { devices: vec![*start], boards: Vec::new() };
    let mut change = SVector::<f64, DEVICE_PARAMETERS>::zeros();
    for _ in 0..ROUNDS {
        let device = moved(&first, &free, &DVector::from_column_slice(change.as_slice())).devices[0];
        let model = Model { devices: vec![device], boards: vec![Isometry3::identity()] };
        let linear: Vec<_> = seen.iter().filter_map(|s| linearize(&model, &observation(s.0, s.1))).collect();
        if linear.is_empty() {
            break;
        }
        let scale = (2.0 * median(linear.iter().map(|l| l.residual[0].abs()))).max(LEAST_PX);
        let mut normal = SMatrix::<f64, DEVICE_PARAMETERS, DEVICE_PARAMETERS>::zeros();
        let mut right = SVector::<f64, DEVICE_PARAMETERS>::zeros();
        for (i, off) in off.iter().enumerate() {
            // Held, or as likely as stated above; one column known to LEAST_PX has the weight 1.
            let weight = if *off > 0.0 { (LEAST_PX / off).powi(2) } else { 1e12 };
            normal[(i, i)] = weight;
            right[i] = -weight * change[i];
        }
        for l in &linear {
            let weight = 1.0 / (1.0 + (l.residual[0] / scale).powi(2));
            let row = l.jacobian.fixed_view::<1, DEVICE_PARAMETERS>(0, 0).transpose();
            normal += weight * row * row.transpose();
            right -= weight * l.residual[0] * row;
        }
        let Some(factor) = normal.cholesky() else { break };
        change += factor.solve(&right);
    }
    moved(&first, &free, &DVector::from_column_slice(change.as_slice())).devices[0]
}
