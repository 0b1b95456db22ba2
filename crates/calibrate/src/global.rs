// SPDX-License-Identifier: MIT OR Apache-2.0
//! Stage 3, section 4.2 of the paper: heads brought into one frame by the positions of the board that several saw, and
//! one last adjustment of everything, so that errors of a loop are spread by the weights of
//! the observations.

use super::board::Board;
use super::bundle::{Adjusted, DeviceModel, Model, Observation, Prior, adjust};
use super::rigging::{HeadResult, Rigging, StageError};
use super::world::{Vertical, into_world};
use crate::data::{Calibration, World};
use crate::geometry::{Device, Pose};
use nalgebra::{Isometry3, UnitQuaternion, Vector3};

/// Two heads saw the same position of the board when their poses agree to this, m and rad, under the nominal rig.
const SAME_POSITION: (f64, f64) = (0.25, 0.35);

/// The relation between two heads' frames, and how well their common positions agree on it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Link {
    /// Places of the heads in the rig.
    pub heads: [usize; 2],
    /// Takes the second head's frame to the first's.
    pub first_from_second: Isometry3<f64>,
    /// How many positions both heads saw.
    pub positions: usize,
    /// RMS distance of the board's corners between both heads' views, after the relation, m.
    pub rms_m: f64,
}

/// Relations of all pairs of heads that saw a position together.
pub fn links(rigging: &Rigging<'_>, heads: &[HeadResult]) -> Vec<Link> {
    let mut links = Vec::new();
    for (i, a) in heads.iter().enumerate() {
        for b in &heads[i + 1..] {
            let pairs: Vec<(Isometry3<f64>, Isometry3<f64>)> = common(a, b);
            let Some(relation) = mean_pose(pairs.iter().map(|(in_a, in_b)| in_a * in_b.inverse())) else {
                continue;
            };
            let corners = rigging.board.corners();
            let squares = pairs.iter().flat_map(|(in_a, in_b)| {
                corners.iter().map(move |c| (in_a * c - relation * (in_b * c)).norm_squared())
            });
            let rms_m = (squares.sum::<f64>() / (pairs.len() * corners.len()) as f64).sqrt();
            links.push(Link {
                heads: [a.head, b.head],
                first_from_second: relation,
                positions: pairs.len(),
                rms_m,
            });
        }
    }
    links
}

/// Board poses of the positions that both heads saw at the same place.
fn common(a: &HeadResult, b: &HeadResult) -> Vec<(Isometry3<f64>, Isometry3<f64>)> {
    let pairs = a.positions.iter().enumerate().filter_map(|(i, position)| {
        let k = b.positions.iter().position(|other| other == position)?;
        let (in_a, in_b) = (a.all.model.boards[i], b.all.model.boards[k]);
        let shift = (in_a.translation.vector - in_b.translation.vector).norm();
        let turn = in_a.rotation.angle_to(&in_b.rotation);
        (shift < SAME_POSITION.0 && turn < SAME_POSITION.1).then_some((in_a, in_b))
    });
    pairs.collect()
}

fn mean_pose(poses: impl Iterator<Item = Isometry3<f64>> + Clone) -> Option<Isometry3<f64>> {
    let first = poses.clone().next()?;
    let n = poses.clone().count() as f64;
    let shift = poses.clone().map(|p| p.translation.vector).sum::<Vector3<f64>>() / n;
    let turn = poses.map(|p| (p.rotation * first.rotation.inverse()).scaled_axis()).sum::<Vector3<f64>>() / n;
    Some(Isometry3::from_parts(shift.into(), UnitQuaternion::from_scaled_axis(turn) * first.rotation))
}

/// All heads in one frame, the world: stage 3 makes it, and `run` turns it into the calibration.
#[derive(Debug, Clone)]
pub struct Together {
    /// The relations between pairs of heads, before the last adjustment.
    pub links: Vec<Link>,
    /// Largest corner displacement around a closed loop of heads, m; `None` without a loop.
    pub loop_error_m: Option<f64>,
    /// One adjustment of everything: per head its cameras, then its projector.
    pub all: Adjusted,
    /// The observations of that adjustment.
    pub observations: Vec<Observation>,
    /// How its frame, the world, was chosen.
    pub world: World,
}

/// Stage 3: brings the heads into one frame, adjusts everything once more, and moves it into the world.
pub fn bring_together(
    rigging: &Rigging<'_>,
    heads: &[HeadResult],
    verticals: &[Vertical],
) -> Result<Together, StageError> {
    let links = links(rigging, heads);
    let frames = frames(rigging, heads, &links)?;
    let loop_error_m = loop_error(rigging.board, heads, &links);
    let Merged { model, positions, mut observations, priors } = merged(rigging, heads, &frames);
    let mut all = adjust(model, &observations, &priors, 0)
        .map_err(|error| StageError::Refused(format!("all heads: {error}")))?;
    observations.shrink_to_fit();
    let devices = |head: &HeadResult| {
        let nominal = &rigging.nominal.heads[head.head];
        let cameras = nominal.cameras.iter().map(|camera| (camera.device.clone(), true));
        cameras.chain([(nominal.projector.clone(), false)]).collect::<Vec<_>>()
    };
    let nominal: Vec<(Device, bool)> = heads.iter().flat_map(devices).collect();
    let world = into_world(&mut all.model, &nominal, &positions, rigging.board, verticals)?;
    Ok(Together { links, loop_error_m, all, observations, world })
}

/// For each head, what takes its frame to the first's: along the links with the best agreement.
fn frames(
    rigging: &Rigging<'_>,
    heads: &[HeadResult],
    links: &[Link],
) -> Result<Vec<Isometry3<f64>>, StageError> {
    let mut found: Vec<Option<Isometry3<f64>>> = vec![None; heads.len()];
    if let Some(first) = found.first_mut() {
        *first = Some(Isometry3::identity());
    }
    let place = |head: usize| heads.iter().position(|h| h.head == head);
    let mut sorted: Vec<&Link> = links.iter().collect();
    sorted.sort_by(|a, b| a.rms_m.total_cmp(&b.rms_m));
    for _ in heads {
        for link in &sorted {
            let (Some(a), Some(b)) = (place(link.heads[0]), place(link.heads[1])) else { continue };
            match (found[a], found[b]) {
                (Some(frame), None) => found[b] = Some(frame * link.first_from_second),
                (None, Some(frame)) => found[a] = Some(frame * link.first_from_second.inverse()),
                _ => {}
            }
        }
    }
    let alone = |h: &HeadResult| {
        StageError::Refused(format!(
            "head {} saw no position of the board together with another head. Show the board between two heads",
            rigging.head_name(h.head)
        ))
    };
    heads.iter().zip(found).map(|(h, frame)| frame.ok_or_else(|| alone(h))).collect()
}

/// Around h0 -> h1 -> ... -> h0, where every neighbour has a link.
fn loop_error(board: &Board, heads: &[HeadResult], links: &[Link]) -> Option<f64> {
    if heads.len() < 3 {
        return None;
    }
    let mut round = Isometry3::identity();
    for i in 0..heads.len() {
        let (a, b) = (heads[i].head, heads[(i + 1) % heads.len()].head);
        let forward = links.iter().find(|l| l.heads == [a, b]).map(|l| l.first_from_second);
        let back = || links.iter().find(|l| l.heads == [b, a]).map(|l| l.first_from_second.inverse());
        round *= forward.or_else(back)?;
    }
    let corners = board.corners().map(|c| c + Vector3::new(0.0, 0.0, 1.0));
    Some(corners.iter().map(|c| (round * c - c).norm()).fold(0.0, f64::max))
}

/// One problem made of all heads' problems.
struct Merged {
    model: Model,
    /// Place in the list of positions of each of the model's boards.
    positions: Vec<usize>,
    observations: Vec<Observation>,
    priors: Vec<Prior>,
}

/// One problem of all heads' problems; positions that are the same become one.
fn merged(rigging: &Rigging<'_>, heads: &[HeadResult], frames: &[Isometry3<f64>]) -> Merged {
    let (mut devices, mut boards) = (Vec::new(), Vec::<(usize, Isometry3<f64>)>::new());
    let (mut observations, mut priors) = (Vec::new(), Vec::new());
    for (head, frame) in heads.iter().zip(frames) {
        let offset = devices.len();
        devices.extend(head.all.model.devices.iter().map(|device| DeviceModel {
            device_from_frame: device.device_from_frame * frame.inverse(),
            ..*device
        }));
        let places: Vec<usize> = head
            .positions
            .iter()
            .zip(&head.all.model.boards)
            .map(|(&position, board)| {
                let board = frame * board;
                let same = |(p, other): &(usize, Isometry3<f64>)| {
                    *p == position
                        && (other.translation.vector - board.translation.vector).norm()
                            < SAME_POSITION.0 / 5.0
                        && other.rotation.angle_to(&board.rotation) < SAME_POSITION.1 / 5.0
                };
                boards.iter().position(same).unwrap_or_else(|| {
                    boards.push((position, board));
                    boards.len() - 1
                })
            })
            .collect();
        observations.extend(head.observations.iter().map(|o| Observation {
            device: o.device + offset,
            board: places[o.board],
            ..*o
        }));
        let moved = devices.len() - 1;
        priors.extend(rigging.priors(head.head).into_iter().map(|prior| Prior {
            device: prior.device + offset,
            // The shift along the rows is wherever the head's own adjustment put it.
            mean: if prior.parameter == 13 {
                devices[moved].device_from_frame.translation.y
            } else {
                prior.mean
            },
            ..prior
        }));
    }
    let (positions, boards) = boards.into_iter().unzip();
    Merged { model: Model { devices, boards }, positions, observations, priors }
}

/// The result as a calibration file has it.
pub fn calibration(nominal: &Calibration, origin: String, model: &Model) -> Calibration {
    let mut devices = model.devices.iter();
    let mut take = |device: &mut Device| {
        if let Some(found) = devices.next() {
            device.lens = found.lens;
            device.world_from_device = Pose::new(found.device_from_frame.inverse());
        }
    };
    let mut result = nominal.clone();
    result.origin = origin;
    for head in &mut result.heads {
        head.cameras.iter_mut().for_each(|camera| take(&mut camera.device));
        take(&mut head.projector);
    }
    result
}
