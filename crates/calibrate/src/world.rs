// SPDX-License-Identifier: MIT OR Apache-2.0
//! The world of a calibration. Photographs of a board show how the devices stand to each other, but not where the floor
//! is: the adjustment holds one camera where the rig file has it, and its error of half a degree there would be the
//! world's.
//!
//! So the adjusted devices are moved together, rigidly, to where they fit the rig file best: each camera votes with its
//! place and with its attitude, as much as a rig file is usually wrong in either. A position of the board that was set
//! up with a spirit level shows better what is vertical; then the world is turned to it.

use super::board::Board;
use super::bundle::{DeviceModel, Model};
use super::rigging::StageError;
use crate::data::World;
use crate::geometry::{Device, best_motion};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

/// How wrong places and attitudes of a rig file are: m along an axis, rad about an axis. Only their quotient matters.
const RIG_FILE: (f64, f64) = (0.010, 0.010);
/// A vertical that is declared must agree with the rig file to this, rad: a wrong number of a position does not.
const DECLARED: f64 = 10.0 / 180.0 * std::f64::consts::PI;

/// What the operator declares of one position of the board; positions are counted from 1, as everywhere in reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Vertical {
    /// Two of its edges were plumb.
    Upright(usize),
    /// It lay level, face up or down.
    Level(usize),
}

impl Vertical {
    fn position(self) -> usize {
        let (Self::Upright(position) | Self::Level(position)) = self;
        position
    }

    fn what(self) -> &'static str {
        match self {
            Self::Upright(_) => "upright",
            Self::Level(_) => "level",
        }
    }

    /// The direction of the board that was vertical and is nearest to `up`.
    fn direction(self, board: &Isometry3<f64>, up: &Vector3<f64>) -> Vector3<f64> {
        let axes: &[Vector3<f64>] = match self {
            Self::Upright(_) => &[Vector3::x(), Vector3::y()],
            Self::Level(_) => &[Vector3::z()],
        };
        let turned = axes.iter().map(|axis| board.rotation * axis);
        let signed = turned.map(|axis| if axis.dot(up) < 0.0 { -axis } else { axis });
        signed.max_by(|a, b| a.dot(up).total_cmp(&b.dot(up))).unwrap_or(*up)
    }
}

/// The motion that brings found poses nearest to nominal ones: `nominal frame from found frame`. Each pose stands for
/// six points on its axes, so far out that places and attitudes weigh by [`RIG_FILE`]; one pose is enough. `None`
/// without.
fn nearest_motion(poses: &[(Isometry3<f64>, Isometry3<f64>)]) -> Option<Isometry3<f64>> {
    // Six points at a distance L move by 6 d² + 4 L² a² in sum for a shift d and a turn by a.
    let reach = RIG_FILE.0 / RIG_FILE.1 * 1.5f64.sqrt();
    let tips = (0..6).map(|i| {
        let mut tip = Vector3::zeros();
        tip[i / 2] = if i % 2 == 0 { reach } else { -reach };
        Point3::from(tip)
    });
    let pairs = poses.iter().flat_map(|(found, nominal)| tips.clone().map(move |t| (found * t, nominal * t)));
    best_motion(&pairs.collect::<Vec<_>>())
}

/// Moves a model of any frame into the world. `nominal` has a device for each of the model's, and whether it is a
/// camera. Cameras vote; projectors do not, because their place along their rows is not measured. `positions` has the
/// number (from 0) of each of the model's boards.
pub(super) fn into_world(
    model: &mut Model,
    nominal: &[(Device, bool)],
    positions: &[usize],
    board: &Board,
    verticals: &[Vertical],
) -> Result<World, StageError> {
    let found = |device: &DeviceModel| device.device_from_frame.inverse();
    let poses = |model: &Model| -> Vec<(Isometry3<f64>, Isometry3<f64>)> {
        let pairs = model.devices.iter().zip(nominal).filter(|(_, (_, is_camera))| *is_camera);
        pairs.map(|(device, (known, _))| (found(device), *known.world_from_device.isometry())).collect()
    };
    if let Some(motion) = nearest_motion(&poses(model)) {
        move_model(model, &motion);
    }
    let turn = vertical_turn(model, positions, verticals)?;
    move_model(model, &about(&turn, &middle(model, board)));
    let poses = poses(model);
    let rms = |of: fn(&(Isometry3<f64>, Isometry3<f64>)) -> f64| {
        let squares = poses.iter().map(|pair| of(pair).powi(2)).sum::<f64>();
        (squares / poses.len().max(1) as f64).sqrt()
    };
    Ok(World {
        cameras: poses.len(),
        places_rms_mm: 1e3 * rms(|(a, b)| (a.translation.vector - b.translation.vector).norm()),
        attitudes_rms_deg: rms(|(a, b)| a.rotation.angle_to(&b.rotation)).to_degrees(),
        vertical_positions: verticals.iter().map(|v| v.position()).collect(),
        vertical_turn_deg: turn.angle().to_degrees(),
    })
}

/// What turns the mean of the declared verticals into the z axis.
fn vertical_turn(
    model: &Model,
    positions: &[usize],
    verticals: &[Vertical],
) -> Result<UnitQuaternion<f64>, StageError> {
    let up = Vector3::z();
    let mut sum = Vector3::zeros();
    for vertical in verticals {
        let (position, what) = (vertical.position(), vertical.what());
        // Two heads that disagree on a position have a board each.
        let mut seen = positions.iter().zip(&model.boards).filter(|(p, _)| **p + 1 == position).peekable();
        if seen.peek().is_none() {
            let mut used: Vec<usize> = positions.iter().map(|p| p + 1).collect();
            used.sort_unstable();
            used.dedup();
            let list: Vec<String> = used.iter().map(ToString::to_string).collect();
            return Err(StageError::World(format!(
                "position {position} was declared {what}, but is not among the {} positions used: {}",
                used.len(),
                list.join(", ")
            )));
        }
        for (_, board) in seen {
            let direction = vertical.direction(board, &up);
            let off = direction.angle(&up);
            if !(off <= DECLARED) {
                return Err(StageError::World(format!(
                    "position {position} was declared {what}, but is {:.1} degrees off with the geometry of the rig file, expected at most 10. Is it another position, or is the rig file wrong?",
                    off.to_degrees()
                )));
            }
            sum += direction;
        }
    }
    Ok(UnitQuaternion::rotation_between(&sum, &up).unwrap_or_default())
}

/// The middle of the corners of all boards. The world is turned about this point, so that the boards stay near where the
/// fit has placed them.
fn middle(model: &Model, board: &Board) -> Point3<f64> {
    let corners = board.corners();
    let all = model.boards.iter().flat_map(|pose| corners.iter().map(move |c| (pose * c).coords));
    let n = (model.boards.len() * corners.len()).max(1) as f64;
    Point3::from(all.sum::<Vector3<f64>>() / n)
}

fn about(turn: &UnitQuaternion<f64>, centre: &Point3<f64>) -> Isometry3<f64> {
    Isometry3::from_parts(Translation3::from(centre.coords - turn * centre.coords), *turn)
}

fn move_model(model: &mut Model, motion: &Isometry3<f64>) {
    for device in &mut model.devices {
        device.device_from_frame *= motion.inverse();
    }
    for board in &mut model.boards {
        *board = motion * *board;
    }
}

#[cfg(test)]
mod tests;
