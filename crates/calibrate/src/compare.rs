// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which lens model? Every variant is fitted without one position of the board at a time, and judged by that position:
//! its circles place the board, and the phase between them must then be what the projector's model says.

use super::bundle::{DEVICE_PARAMETERS, Model, Prior, adjust};
use super::consistency::Excluded;
use super::stages::{HeadResult, Rigging, StageError, Terms, project};
use super::start::board_pose;
use nalgebra::{DMatrix, DVector, Isometry3, Point3};
use rayon::iter::{IntoParallelRefIterator, ParallelIterator};

/// What is tried: a name, and the terms.
pub const VARIANTS: [(&str, Terms); 6] = {
    let base =
        Terms { camera_k3: false, camera_tangential: true, projector_k2: true, projector_tangential: true };
    [
        ("k1 k2 p1 p2; projector k1 k2 p1 p2", base),
        ("k1 k2 k3 p1 p2; projector k1 k2 p1 p2", Terms { camera_k3: true, ..base }),
        ("k1 k2; projector k1 k2 p1 p2", Terms { camera_tangential: false, ..base }),
        ("k1 k2 p1 p2; projector k1 k2", Terms { projector_tangential: false, ..base }),
        ("k1 k2 p1 p2; projector k1 p1 p2", Terms { projector_k2: false, ..base }),
        ("k1 k2 p1 p2; projector k1", Terms { projector_k2: false, projector_tangential: false, ..base }),
    ]
};

/// Residuals on positions that were left out of the fit, RMS.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct LeftOut {
    /// Positions judged.
    pub positions: usize,
    /// Of circles, along one axis, px.
    pub circles_px: f64,
    /// Of phases, panel px.
    pub phases_px: f64,
    /// The same as an error of depth along the camera's ray, mm.
    pub depth_mm: f64,
    /// Of depth, when the phase is corrected by a grid over each camera's image that was fitted to the residuals of the
    /// other positions, mm.
    pub gridded_depth_mm: f64,
}

#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    circles: [f64; 2],
    phases: [f64; 2],
    depth: f64,
    gridded: f64,
}

/// Residuals of one head's positions, each left out of the fit in turn. An error when no position can be spared.
pub fn leave_one_out(rigging: &Rigging<'_>, head: usize) -> Result<LeftOut, StageError> {
    let full = rigging.attempt(head, &Excluded::default())?;
    let cameras = rigging.nominal.heads[head].cameras.len();
    let attempts: Vec<Result<Sums, StageError>> = full
        .positions
        .par_iter()
        .filter_map(|&position| {
            let fitted = rigging.attempt(head, &Excluded::position(position, cameras));
            fitted.map(|fitted| judge(rigging, &fitted, position)).transpose()
        })
        .collect();
    let (mut judged, mut too_little) = (Vec::new(), None);
    for attempt in attempts {
        match attempt {
            Ok(sums) => judged.push(sums),
            // Without this one too little is left; that is no statement about the model.
            Err(error @ (StageError::Positions { .. } | StageError::Parallel { .. })) => {
                too_little = Some(error);
            }
            Err(error) => return Err(error),
        }
    }
    if let Some(error) = too_little.filter(|_| judged.is_empty()) {
        return Err(error);
    }
    let positions = judged.len();
    let all = judged.iter().fold(Sums::default(), |a, b| Sums {
        circles: [a.circles[0] + b.circles[0], a.circles[1] + b.circles[1]],
        phases: [a.phases[0] + b.phases[0], a.phases[1] + b.phases[1]],
        depth: a.depth + b.depth,
        gridded: a.gridded + b.gridded,
    });
    let rms = |sum: f64, n: f64| (sum / n.max(1.0)).sqrt();
    Ok(LeftOut {
        positions,
        circles_px: rms(all.circles[0], all.circles[1]),
        phases_px: rms(all.phases[0], all.phases[1]),
        depth_mm: rms(all.depth, all.phases[1]) * 1e3,
        gridded_depth_mm: rms(all.gridded, all.phases[1]) * 1e3,
    })
}

/// Places the board by its circles with all devices held, and compares the phase.
fn judge(rigging: &Rigging<'_>, fitted: &HeadResult, position: usize) -> Option<Sums> {
    let devices = &fitted.all.model.devices;
    let (head, projector) = (fitted.head, devices.len() - 1);
    let none = Excluded::default();
    let circles = rigging.circles(head, &[position], &none);
    let first = rigging.first_camera(head);
    let start = (0..projector).find_map(|camera| {
        let view = rigging.positions[position].views[first + camera].as_ref()?;
        let pose = board_pose(rigging.board, &view.sightings, &devices[camera].lens)?;
        Some(devices[camera].device_from_frame.inverse() * pose)
    })?;
    let held: Vec<Prior> = (0..projector)
        .flat_map(|device| {
            (0..DEVICE_PARAMETERS).map(move |parameter| Prior { device, parameter, mean: 0.0, sigma: 0.0 })
        })
        .collect();
    let mut model = Model { devices: devices.clone(), boards: vec![start] };
    let mut sums = Sums::default();
    for _ in 0..2 {
        let observations = rigging.corrected(&model, &circles);
        let adjusted = adjust(model, &observations, &held, 0).ok()?;
        let kept = adjusted.residuals.iter().zip(&adjusted.outliers).filter(|(_, out)| !**out);
        sums.circles = kept.fold([0.0; 2], |[sum, n], ([u, v], _)| [sum + u * u + v * v, n + 2.0]);
        model = adjusted.model;
    }
    for camera in 0..projector {
        let grid = Grid::fit(rigging, fitted, camera);
        for o in rigging.phases(head, camera, &[position], &model, &none) {
            let board = &model.boards[0];
            let Some([column, _]) = project(&devices[projector], board, &o.point) else { continue };
            let Some(place) = Place::of(&model, camera, board, &o.point) else { continue };
            let Some(per_metre) = columns_per_metre(&model, camera, projector, board, &o.point) else {
                continue;
            };
            let off = column - o.measured[0];
            // A wrong order or something else in front is no matter of the lens.
            if off.abs() > 1.0 {
                continue;
            }
            let left = off - grid.as_ref().map_or(0.0, |grid| grid.at(&place));
            sums.phases = [sums.phases[0] + off * off, sums.phases[1] + 1.0];
            sums.depth += (off / per_metre).powi(2);
            sums.gridded += (left / per_metre).powi(2);
        }
    }
    (sums.phases[1] > 0.0).then_some(sums)
}

/// Panel columns per metre along the camera's ray through a point.
fn columns_per_metre(
    model: &Model,
    camera: usize,
    projector: usize,
    board: &Isometry3<f64>,
    point: &Point3<f64>,
) -> Option<f64> {
    const STEP_M: f64 = 1e-3;
    let in_camera = model.devices[camera].device_from_frame * (board * point);
    let along = in_camera.coords.normalize() * STEP_M;
    let world = |p: Point3<f64>| model.devices[camera].device_from_frame.inverse() * p;
    let identity = Isometry3::identity();
    let column = |p: Point3<f64>| project(&model.devices[projector], &identity, &world(p)).map(|[u, _]| u);
    let slope = (column(in_camera + along)? - column(in_camera - along)?) / (2.0 * STEP_M);
    (slope.abs() > 1.0).then_some(slope)
}

/// Where a camera sees a point: pixel and inverse depth (1/m).
struct Place {
    pixel: [f64; 2],
    nearness: f64,
}

impl Place {
    fn of(model: &Model, camera: usize, board: &Isometry3<f64>, point: &Point3<f64>) -> Option<Self> {
        let device = &model.devices[camera];
        let z = (device.device_from_frame * (board * point)).z;
        Some(Self { pixel: project(device, board, point)?, nearness: 1.0 / z })
    }
}

/// A correction of the panel column, bilinear between the nodes of a coarse grid over the image, each linear in the
/// inverse depth.
struct Grid {
    coefficients: DVector<f64>,
    size: [f64; 2],
    middle: f64,
}

/// Nodes of the grid along u and v.
const NODES: [usize; 2] = [8, 5];
/// How large a correction is expected, panel px: without it, empty cells would be free.
const EXPECTED_PX: f64 = 0.02;

impl Grid {
    /// Fits the residuals of one camera's phases.
    fn fit(rigging: &Rigging<'_>, fitted: &HeadResult, camera: usize) -> Option<Self> {
        let device = &rigging.nominal.heads[fitted.head].cameras[camera].device;
        let mut samples = Vec::new();
        for (i, _) in fitted.phase_cameras.iter().enumerate().filter(|(_, of)| **of == camera) {
            let i = fitted.circles + i;
            let o = &fitted.observations[i];
            let board = &fitted.all.model.boards[o.board];
            if fitted.all.outliers[i] {
                continue;
            }
            if let Some(place) = Place::of(&fitted.all.model, camera, board, &o.point) {
                samples.push((place, fitted.all.residuals[i][0], o.sigma_px));
            }
        }
        let middle =
            samples.iter().map(|(place, ..)| place.nearness).sum::<f64>() / samples.len().max(1) as f64;
        let unknowns = 2 * NODES[0] * NODES[1];
        let empty = DVector::zeros(unknowns);
        let mut grid =
            Self { coefficients: empty, size: [device.width as f64, device.height as f64], middle };
        let mut matrix = DMatrix::from_diagonal_element(unknowns, unknowns, EXPECTED_PX.powi(-2));
        let mut right = DVector::zeros(unknowns);
        for (place, residual, sigma) in &samples {
            let terms = grid.terms(place);
            let weight = sigma.powi(-2);
            for &(i, a) in &terms {
                right[i] += weight * a * residual;
                terms.iter().for_each(|&(k, b)| matrix[(i, k)] += weight * a * b);
            }
        }
        grid.coefficients = matrix.cholesky()?.solve(&right);
        Some(grid)
    }

    fn at(&self, place: &Place) -> f64 {
        self.terms(place).iter().map(|&(i, a)| a * self.coefficients[i]).sum()
    }

    /// The coefficients that matter at a place, each with its share.
    fn terms(&self, place: &Place) -> [(usize, f64); 8] {
        let along = |axis: usize| {
            let last = (NODES[axis] - 1) as f64;
            let x = (place.pixel[axis] / self.size[axis]).clamp(0.0, 1.0) * last;
            let cell = x.floor().min(last - 1.0);
            (cell as usize, x - cell)
        };
        let ((u, a), (v, b)) = (along(0), along(1));
        let deep = 4.0 * (place.nearness - self.middle);
        let nodes =
            [(0, 0, (1.0 - a) * (1.0 - b)), (1, 0, a * (1.0 - b)), (0, 1, (1.0 - a) * b), (1, 1, a * b)];
        std::array::from_fn(|i| {
            let (du, dv, share) = nodes[i / 2];
            let node = (v + dv) * NODES[0] + u + du;
            (2 * node + i % 2, if i % 2 == 0 { share } else { share * deep })
        })
    }
}
