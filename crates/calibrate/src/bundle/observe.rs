// SPDX-License-Identifier: MIT OR Apache-2.0
//! One observation: its residual, and how that depends on every parameter.

use super::{DEVICE_PARAMETERS, DeviceModel, Model, Observation, POSE_PARAMETERS};
use nalgebra::{Isometry3, Matrix2x3, Point3, SMatrix, Vector2};

/// Parameters that one observation depends on: lens, device pose, board pose.
pub(super) const BLOCK: usize = DEVICE_PARAMETERS + POSE_PARAMETERS;

/// Residual (predicted minus measured, px) and its derivatives, the columns ordered as in [`BLOCK`].
pub(super) struct Linearized {
    pub(super) residual: Vector2<f64>,
    pub(super) jacobian: SMatrix<f64, 2, BLOCK>,
}

/// The pixel at which a device sees a board point; `None` behind the device.
pub fn project(
    device: &DeviceModel,
    frame_from_board: &Isometry3<f64>,
    point: &Point3<f64>,
) -> Option<[f64; 2]> {
    let p = device.device_from_frame * (frame_from_board * point);
    (p.z > 1e-6).then(|| device.lens.distort(p.x / p.z, p.y / p.z)).flatten()
}

/// Where `observation` should have been seen; `None` behind the device.
pub(super) fn predict(model: &Model, observation: &Observation) -> Option<[f64; 2]> {
    project(&model.devices[observation.device], &model.boards[observation.board], &observation.point)
}

/// First order of the residual around `model`.
pub(super) fn linearize(model: &Model, observation: &Observation) -> Option<Linearized> {
    let device = &model.devices[observation.device];
    let (board, pose) = (&model.boards[observation.board], &device.device_from_frame);
    let turned = board.rotation * observation.point.coords;
    let in_frame = turned + board.translation.vector;
    let seen = pose.rotation * in_frame;
    let p = seen + pose.translation.vector;
    if !(p.z > 1e-6) {
        return None;
    }
    let (x, y) = (p.x / p.z, p.y / p.z);
    let lens = &device.lens;
    let [xd, yd] = lens.distorted(x, y);
    let [[a, b], [c, d]] = lens.jacobian(x, y);
    let spread = Matrix2x3::new(1.0, 0.0, -x, 0.0, 1.0, -y) / p.z;
    let pixel_from_point =
        nalgebra::Matrix2::new(lens.fx * a, lens.fx * b, lens.fy * c, lens.fy * d) * spread;
    let mut jacobian = SMatrix::<f64, 2, BLOCK>::zeros();
    let r2 = x * x + y * y;
    jacobian[(0, 0)] = xd;
    jacobian[(1, 1)] = yd;
    jacobian[(0, 2)] = 1.0;
    jacobian[(1, 3)] = 1.0;
    let lens_columns = [
        [x * r2, y * r2],
        [x * r2 * r2, y * r2 * r2],
        [2.0 * x * y, r2 + 2.0 * y * y],
        [r2 + 2.0 * x * x, 2.0 * x * y],
        [x * r2 * r2 * r2, y * r2 * r2 * r2],
    ];
    for (i, [du, dv]) in lens_columns.into_iter().enumerate() {
        jacobian[(0, 4 + i)] = lens.fx * du;
        jacobian[(1, 4 + i)] = lens.fy * dv;
    }
    let place = |jacobian: &mut SMatrix<f64, 2, BLOCK>, at: usize, block: &Matrix2x3<f64>| {
        jacobian.fixed_view_mut::<2, 3>(0, at).copy_from(block);
    };
    // A small turn w of the device changes R X by w x (R X).
    place(&mut jacobian, 9, &(-pixel_from_point * seen.cross_matrix()));
    place(&mut jacobian, 12, &pixel_from_point);
    let pixel_from_frame = pixel_from_point * pose.rotation.to_rotation_matrix().matrix();
    place(&mut jacobian, DEVICE_PARAMETERS, &(-pixel_from_frame * turned.cross_matrix()));
    place(&mut jacobian, DEVICE_PARAMETERS + 3, &pixel_from_frame);
    let predicted = Vector2::new(lens.fx * xd + lens.cx, lens.fy * yd + lens.cy);
    Some(Linearized { residual: predicted - Vector2::from(observation.measured), jacobian })
}
