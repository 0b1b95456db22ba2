// SPDX-License-Identifier: MIT OR Apache-2.0
//! Checks that the cameras stand where the rig file has them. Two cameras whose cables or files were exchanged see the
//! board where it is not. An adjustment would follow them, and all numbers would look good.

use super::board::Board;
use super::estimate::median;
use super::observed::Position;
use super::rigging::StageError;
use super::start::board_pose;
use crate::data::Calibration;
use nalgebra::{Isometry3, Point3};

/// Cameras must agree on where the board is to this, m, with the geometry of the rig file.
const AGREE_M: f64 = 0.25;

/// Compares where the cameras see the board, each with the place that the rig file gives it.
pub fn check_placement(
    nominal: &Calibration,
    board: &Board,
    positions: &[Position],
) -> Result<(), StageError> {
    let cameras: Vec<_> = nominal.cameras().map(|(_, camera)| camera).collect();
    let seen: Vec<Vec<Option<Isometry3<f64>>>> = cameras
        .iter()
        .enumerate()
        .map(|(c, camera)| {
            let pose = |p: &Position| board_pose(board, &p.views[c].as_ref()?.sightings, &camera.device.lens);
            positions.iter().map(pose).collect()
        })
        .collect();
    let places: Vec<Isometry3<f64>> =
        cameras.iter().map(|camera| *camera.device.world_from_device.isometry()).collect();
    let heads = nominal.cameras().map(|(head, _)| head.id.as_str()).collect();
    let scene = Scene { seen, places, heads, corners: board.corners() };
    let order: Vec<usize> = (0..cameras.len()).collect();
    let Some((worst, [a, b])) = scene.worst(&order).filter(|(worst, _)| *worst > AGREE_M) else {
        return Ok(());
    };
    let name = |c: usize| &cameras[c].id;
    for i in 0..order.len() {
        for k in i + 1..order.len() {
            let mut swapped = order.clone();
            swapped.swap(i, k);
            let involved = [a, b].iter().any(|c| [i, k].contains(c));
            if involved && scene.worst(&swapped).is_some_and(|(left, _)| left <= AGREE_M) {
                return Err(StageError::Refused(format!(
                    "cameras {} and {} are swapped: each sees the board where the other one should. Exchange their cables, addresses or directories",
                    name(i),
                    name(k)
                )));
            }
        }
    }
    Err(StageError::Refused(format!(
        "cameras {} and {} see the board {} mm apart with the geometry of the rig file, expected at most 250. Correct the rig file, or find the camera that is not where the file has it",
        name(a),
        name(b),
        (worst * 1e3) as u32
    )))
}

struct Scene<'a> {
    /// By camera and position, `camera_from_board`.
    seen: Vec<Vec<Option<Isometry3<f64>>>>,
    /// By camera, `world_from_camera` of the rig file.
    places: Vec<Isometry3<f64>>,
    /// By camera, the name of its head.
    heads: Vec<&'a str>,
    corners: [Point3<f64>; 4],
}

impl Scene<'_> {
    /// The pair of cameras that disagree most, when the images of camera c were taken at `places[order[c]]`: distance
    /// of the board's corners, m. Within a head the median over their common positions; between heads the least: heads
    /// may have been calibrated one by one, each with its own board under the same trigger, and only some positions are
    /// common to them.
    fn worst(&self, order: &[usize]) -> Option<(f64, [usize; 2])> {
        let mut worst: Option<(f64, [usize; 2])> = None;
        for a in 0..order.len() {
            for b in a + 1..order.len() {
                let both = self.seen[a].iter().zip(&self.seen[b]);
                let apart = both.filter_map(|(in_a, in_b)| {
                    let (in_a, in_b) = (self.places[order[a]] * (*in_a)?, self.places[order[b]] * (*in_b)?);
                    let squares = self.corners.iter().map(|c| (in_a * c - in_b * c).norm_squared());
                    Some((squares.sum::<f64>() / 4.0).sqrt())
                });
                let apart = match self.heads[order[a]] == self.heads[order[b]] {
                    true => median(apart),
                    false => apart.fold(f64::NAN, f64::min),
                };
                if !apart.is_nan() && worst.is_none_or(|(most, _)| apart > most) {
                    worst = Some((apart, [a, b]));
                }
            }
        }
        worst
    }
}
