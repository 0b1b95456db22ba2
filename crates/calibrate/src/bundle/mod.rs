// SPDX-License-Identifier: MIT OR Apache-2.0
//! Bundle adjustment: lenses, device poses and board poses that explain best where the board's points were seen
//! (Triggs et al. 1999; damped least squares after Levenberg and Marquardt, with a robust loss).
//!
//! A projector is a device that sees columns only: the absolute phase of a board point is the panel column that
//! lights it. Everything is dense, because a rig has a few hundred parameters.

mod observe;
mod one_device;

use crate::geometry::Lens;
use nalgebra::{DMatrix, DVector, Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
pub(super) use observe::project;
use observe::{BLOCK, linearize, predict};
pub(super) use one_device::{SeenColumn, column_error, fit_columns};

/// Number of a lens's parameters: fx, fy, cx, cy, k1, k2, p1, p2, k3.
pub const LENS_PARAMETERS: usize = 9;
/// Number of a pose's parameters: a small turn (rad), then a shift (m), both in the target's axes.
pub const POSE_PARAMETERS: usize = 6;
/// Number of a device's parameters: those of the lens, then those of the pose.
pub const DEVICE_PARAMETERS: usize = LENS_PARAMETERS + POSE_PARAMETERS;

/// Names of a device's parameters, in order.
pub const DEVICE_PARAMETER_NAMES: [&str; DEVICE_PARAMETERS] =
    ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "rx", "ry", "rz", "tx", "ty", "tz"];

/// A camera or a projector as the adjustment sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DeviceModel {
    pub lens: Lens,
    /// Takes coordinates of the common frame to the device's.
    pub device_from_frame: Isometry3<f64>,
}

/// Everything that an adjustment estimates: devices and positions of the board.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    /// Cameras and projectors; observations name them by place.
    pub devices: Vec<DeviceModel>,
    /// Per position of the board: takes board coordinates to the common frame.
    pub boards: Vec<Isometry3<f64>>,
}

/// A point of the board that a device saw.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// Place among the model's devices.
    pub device: usize,
    /// Place among the model's positions of the board.
    pub board: usize,
    /// The point, board frame, m.
    pub point: Point3<f64>,
    /// Where it was seen (u, v), px.
    pub measured: [f64; 2],
    /// Standard deviation of that, px.
    pub sigma_px: f64,
    /// Whether only the column was measured, as by a projector.
    pub columns_only: bool,
}

/// What is known of a device's parameter beforehand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prior {
    pub device: usize,
    /// Which of its parameters: a lens parameter, or a shift (the last three).
    pub parameter: usize,
    pub mean: f64,
    /// How well it is known; 0: it is held.
    pub sigma: f64,
}

/// An adjusted model: `adjust` makes it, and the stages keep one per head and one of all heads.
#[derive(Debug, Clone)]
pub struct Adjusted {
    pub model: Model,
    /// Predicted minus measured, px, by observation; NaN where it is behind the device.
    pub residuals: Vec<[f64; 2]>,
    /// Observations that were left with less than a tenth of their weight.
    pub outliers: Vec<bool>,
    /// Standard deviation of each device parameter, in the order of [`DEVICE_PARAMETER_NAMES`]; 0 where held.
    pub device_sigma: Vec<[f64; DEVICE_PARAMETERS]>,
    /// RMS of the residuals that count, in units of their stated standard deviation.
    pub chi: f64,
}

/// Residuals beyond this many standard deviations count less (Cauchy's loss).
const ROBUST: f64 = 3.0;
/// Most steps of one adjustment: they bound its time where it does not converge.
const MAX_STEPS: usize = 100;
/// Converged when a step lowers the cost by less than this share.
const TOLERANCE: f64 = 1e-10;

/// Adjusts everything that is not held. The pose of device `anchor` is held: it is the frame.
///
/// An error names what the observations do not determine, and what to do.
pub fn adjust(
    start: Model,
    observations: &[Observation],
    priors: &[Prior],
    anchor: usize,
) -> Result<Adjusted, String> {
    let free = free_parameters(&start, observations, priors, anchor);
    let unknowns = free.iter().flatten().count();
    let equations: usize = observations.iter().map(Observation::equations).sum();
    if equations + priors.len() < unknowns {
        return Err(format!(
            "{equations} equations for {unknowns} unknowns: more positions of the board are needed"
        ));
    }
    let problem = Problem { observations, priors, free, unknowns };
    let mut model = start;
    let mut damping = 1e-4;
    let mut cost = problem.cost(&model);
    for _ in 0..MAX_STEPS {
        let normal = problem.accumulate(&model, true);
        let Some((next, next_cost)) = problem.step(&model, &normal, &mut damping, cost) else { break };
        let gain = (cost - next_cost) / cost.max(1e-300);
        (model, cost) = (next, next_cost);
        if gain < TOLERANCE {
            break;
        }
    }
    problem.finish(model)
}

/// What an adjustment minimizes: it stays the same from step to step.
struct Problem<'a> {
    observations: &'a [Observation],
    priors: &'a [Prior],
    /// For every parameter its place among the unknowns; `None` where it is held.
    free: Vec<Option<usize>>,
    unknowns: usize,
}

/// The normal equations of one step.
struct Normal {
    matrix: DMatrix<f64>,
    gradient: DVector<f64>,
}

/// For every parameter its place among the unknowns.
fn free_parameters(
    model: &Model,
    observations: &[Observation],
    priors: &[Prior],
    anchor: usize,
) -> Vec<Option<usize>> {
    let devices = model.devices.len() * DEVICE_PARAMETERS;
    let mut is_free = vec![false; devices + model.boards.len() * POSE_PARAMETERS];
    for o in observations {
        is_free[o.device * DEVICE_PARAMETERS..][..DEVICE_PARAMETERS].fill(true);
        is_free[devices + o.board * POSE_PARAMETERS..][..POSE_PARAMETERS].fill(true);
    }
    is_free[anchor * DEVICE_PARAMETERS + LENS_PARAMETERS..][..POSE_PARAMETERS].fill(false);
    for prior in priors.iter().filter(|prior| prior.sigma == 0.0) {
        is_free[prior.device * DEVICE_PARAMETERS + prior.parameter] = false;
    }
    let mut next = 0..;
    is_free.into_iter().map(|free| if free { next.next() } else { None }).collect()
}

fn weight(squared: f64) -> f64 {
    1.0 / (1.0 + squared / (ROBUST * ROBUST))
}

fn loss(squared: f64) -> f64 {
    ROBUST * ROBUST * (1.0 + squared / (ROBUST * ROBUST)).ln()
}

fn squared_sigmas(residual: [f64; 2], o: &Observation) -> f64 {
    let v = if o.columns_only { 0.0 } else { residual[1] };
    (residual[0] * residual[0] + v * v) / (o.sigma_px * o.sigma_px)
}

fn residual_of(model: &Model, o: &Observation) -> Option<[f64; 2]> {
    predict(model, o).map(|[u, v]| [u - o.measured[0], v - o.measured[1]])
}

fn prior_residual(model: &Model, prior: &Prior) -> f64 {
    (parameter(&model.devices[prior.device], prior.parameter) - prior.mean) / prior.sigma
}

/// A lens parameter or a shift.
fn parameter(device: &DeviceModel, which: usize) -> f64 {
    let lens = &device.lens;
    match which {
        0 => lens.fx,
        1 => lens.fy,
        2 => lens.cx,
        3 => lens.cy,
        4..=8 => lens.distortion[which - 4],
        12..=14 => device.device_from_frame.translation.vector[which - 12],
        _ => 0.0,
    }
}

impl Observation {
    /// How many equations it gives.
    fn equations(&self) -> usize {
        if self.columns_only { 1 } else { 2 }
    }
}

impl Problem<'_> {
    fn cost(&self, model: &Model) -> f64 {
        // A point behind its device costs more than any other, so that no step moves one there.
        let loss = |o: &Observation| residual_of(model, o).map_or(1e6, |r| loss(squared_sigmas(r, o)));
        let seen: f64 = self.observations.iter().map(loss).sum();
        let known = self.priors.iter().filter(|p| p.sigma > 0.0);
        seen + known.map(|p| prior_residual(model, p).powi(2)).sum::<f64>()
    }

    fn accumulate(&self, model: &Model, robust: bool) -> Normal {
        let mut matrix = DMatrix::zeros(self.unknowns, self.unknowns);
        let mut gradient = DVector::zeros(self.unknowns);
        let boards_at = model.devices.len() * DEVICE_PARAMETERS;
        for o in self.observations {
            let Some(linear) = linearize(model, o) else { continue };
            let squared = squared_sigmas(linear.residual.into(), o);
            let w = weight(squared);
            if !robust && w < 0.1 {
                continue;
            }
            let scale = if robust { w } else { 1.0 } / (o.sigma_px * o.sigma_px);
            let place = |i: usize| match i.checked_sub(DEVICE_PARAMETERS) {
                None => self.free[o.device * DEVICE_PARAMETERS + i],
                Some(i) => self.free[boards_at + o.board * POSE_PARAMETERS + i],
            };
            let places: [Option<usize>; BLOCK] = std::array::from_fn(place);
            for row in 0..o.equations() {
                for (i, place) in places.iter().enumerate() {
                    let Some(a) = *place else { continue };
                    let ji = scale * linear.jacobian[(row, i)];
                    gradient[a] += ji * linear.residual[row];
                    for (k, place) in places.iter().enumerate() {
                        if let Some(b) = *place {
                            matrix[(a, b)] += ji * linear.jacobian[(row, k)];
                        }
                    }
                }
            }
        }
        for prior in self.priors.iter().filter(|prior| prior.sigma > 0.0) {
            if let Some(place) = self.free[prior.device * DEVICE_PARAMETERS + prior.parameter] {
                matrix[(place, place)] += prior.sigma.powi(-2);
                gradient[place] += prior_residual(model, prior) / prior.sigma;
            }
        }
        Normal { matrix, gradient }
    }

    /// The next model that is better, damped as much as needed; `None` where none is.
    fn step(&self, model: &Model, normal: &Normal, damping: &mut f64, cost: f64) -> Option<(Model, f64)> {
        for _ in 0..20 {
            let mut damped = normal.matrix.clone();
            for i in 0..damped.nrows() {
                damped[(i, i)] *= 1.0 + *damping;
                damped[(i, i)] += 1e-12;
            }
            if let Some(factor) = damped.cholesky() {
                let next = moved(model, &self.free, &-factor.solve(&normal.gradient));
                let next_cost = self.cost(&next);
                if next_cost < cost {
                    *damping = (*damping / 5.0).max(1e-12);
                    return Some((next, next_cost));
                }
            }
            *damping *= 4.0;
        }
        None
    }

    fn finish(&self, model: Model) -> Result<Adjusted, String> {
        let Self { observations, free, unknowns, .. } = self;
        let residual = |o: &Observation| residual_of(&model, o).unwrap_or([f64::NAN; 2]);
        let residuals: Vec<[f64; 2]> = observations.iter().map(residual).collect();
        let squares: Vec<f64> =
            residuals.iter().zip(*observations).map(|(r, o)| squared_sigmas(*r, o)).collect();
        let outliers: Vec<bool> = squares.iter().map(|s| !(weight(*s) >= 0.1)).collect();
        let kept = || squares.iter().zip(*observations).zip(&outliers).filter(|(_, out)| !**out);
        let sum: f64 = kept().map(|((square, _), _)| square).sum();
        let equations: usize = kept().map(|((_, o), _)| o.equations()).sum();
        let chi = (sum / equations.saturating_sub(*unknowns).max(1) as f64).sqrt();
        let normal = self.accumulate(&model, false);
        let Some(covariance) = normal.matrix.clone().cholesky().map(|factor| factor.inverse()) else {
            let weakest =
                (0..*unknowns).min_by(|a, b| normal.matrix[(*a, *a)].total_cmp(&normal.matrix[(*b, *b)]));
            let parameter = weakest.and_then(|w| free.iter().position(|f| *f == Some(w)));
            return Err(format!(
                "{} is not determined by the observations: more and more strongly tilted positions are needed",
                parameter_name(&model, parameter.unwrap_or(0))
            ));
        };
        let sigma = |i: usize| free[i].map_or(0.0, |place| chi * covariance[(place, place)].max(0.0).sqrt());
        let device_sigma = (0..model.devices.len())
            .map(|d| std::array::from_fn(|i| sigma(d * DEVICE_PARAMETERS + i)))
            .collect();
        Ok(Adjusted { model, residuals, outliers, device_sigma, chi })
    }
}

fn moved(model: &Model, free: &[Option<usize>], delta: &DVector<f64>) -> Model {
    let value = |i: usize| free[i].map_or(0.0, |place| delta[place]);
    let pose = |pose: &Isometry3<f64>, at: usize| {
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(value(at), value(at + 1), value(at + 2)));
        let shift = Vector3::new(value(at + 3), value(at + 4), value(at + 5));
        Isometry3::from_parts(Translation3::from(pose.translation.vector + shift), turn * pose.rotation)
    };
    let device = |(d, device): (usize, &DeviceModel)| {
        let at = d * DEVICE_PARAMETERS;
        let mut lens = device.lens;
        lens.fx += value(at);
        lens.fy += value(at + 1);
        lens.cx += value(at + 2);
        lens.cy += value(at + 3);
        lens.distortion.iter_mut().enumerate().for_each(|(i, k)| *k += value(at + 4 + i));
        DeviceModel { lens, device_from_frame: pose(&device.device_from_frame, at + LENS_PARAMETERS) }
    };
    let boards_at = model.devices.len() * DEVICE_PARAMETERS;
    let board = |(b, board): (usize, &Isometry3<f64>)| pose(board, boards_at + b * POSE_PARAMETERS);
    Model {
        devices: model.devices.iter().enumerate().map(device).collect(),
        boards: model.boards.iter().enumerate().map(board).collect(),
    }
}

fn parameter_name(model: &Model, index: usize) -> String {
    let boards_at = model.devices.len() * DEVICE_PARAMETERS;
    match index.checked_sub(boards_at) {
        None => format!(
            "{} of device {}",
            DEVICE_PARAMETER_NAMES[index % DEVICE_PARAMETERS],
            index / DEVICE_PARAMETERS
        ),
        Some(i) => format!("the pose of board position {}", i / POSE_PARAMETERS),
    }
}

#[cfg(test)]
mod tests;
