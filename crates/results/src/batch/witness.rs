// SPDX-License-Identifier: MIT OR Apache-2.0
//! The light as a witness of the trigger: a frame that is filed one trigger wrong shows the body where the others
//! have it at another one.
//!
//! Places of a camera's cloud are compared with the clouds of the other cameras, at its own trigger and at those near
//! it. A place votes against a frame where it lies well off the surface that another camera has at the frame's own
//! trigger, and on the surface that this camera has at another trigger; in the opposite case it votes for the frame.
//! A body that stands still gives no votes (docs/design/reconstruction.md, "The light as a witness").

use crate::data::{Calibration, Cloud};
use crate::geometry::Device;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// How many triggers away, to each side, the true trigger of a frame is looked for.
pub const REACH: u64 = 5;
/// Side of the cells of a sketch, px: one place of each is kept.
const CELL_PX: usize = 8;
/// A place is off a surface that is further away than this, m: twice [`ON_M`], so that noise does not decide.
const OFF_M: f32 = 2e-3;
/// A place is on a surface that is nearer than this, m. Cameras that differ by as much contradict the calibration,
/// and are refused before.
const ON_M: f32 = 1e-3;
/// A surface that is further away than this is another one, m.
const NEAR_M: f32 = 0.05;
/// The least number of places by which a camera gives evidence: fewer may be noise.
const LEAST_PLACES: u32 = 40;
/// The least number of places on one side for each place on the other.
const TO_ONE: u32 = 10;

/// A cloud, thinned to one place a cell of its camera's pixels.
pub struct Sketch {
    columns: usize,
    cells: Vec<Option<(Point3<f32>, Vector3<f32>)>>,
    places: Vec<u32>,
}

impl Sketch {
    /// Of a camera's directional cloud; of two points in a cell the first one.
    pub fn new(cloud: &Cloud, device: &Device) -> Self {
        let (columns, rows) = (device.width.div_ceil(CELL_PX), device.height.div_ceil(CELL_PX));
        let mut sketch = Self { columns, cells: vec![None; columns * rows], places: Vec::new() };
        for ((position, normal), [u, v]) in cloud.position_m.iter().zip(&cloud.normal).zip(&cloud.pixel) {
            let cell = usize::from(*v) / CELL_PX * columns + usize::from(*u) / CELL_PX;
            if let Some(empty) = sketch.cells.get_mut(cell).filter(|cell| cell.is_none()) {
                *empty = Some((Point3::from(*position), Vector3::from(*normal)));
                sketch.places.push(cell as u32);
            }
        }
        sketch
    }

    /// How far a place is from the surface that this camera sees about the pixel; `None` where it sees none near.
    fn distance_m(&self, place: &Point3<f32>, [u, v]: [usize; 2]) -> Option<f32> {
        let (column, row) = (u / CELL_PX, v / CELL_PX);
        let mut nearest: Option<(f32, f32)> = None;
        for row in row.saturating_sub(1)..=row + 1 {
            for column in column.saturating_sub(1)..=(column + 1).min(self.columns - 1) {
                let Some(Some((there, normal))) = self.cells.get(row * self.columns + column) else {
                    continue;
                };
                let apart = place - there;
                let squared = apart.norm_squared();
                if squared < NEAR_M * NEAR_M && nearest.is_none_or(|(least, _)| squared < least) {
                    nearest = Some((squared, apart.dot(normal).abs()));
                }
            }
        }
        nearest.map(|(_, distance)| distance)
    }
}

/// The sketches of a trigger's clouds, by the camera's place in the calibration; `None` where there is no cloud.
pub type Sketches = Vec<Option<Sketch>>;

/// Votes of places for a frame's own trigger, and for another one.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Votes {
    /// The number of places that vote for the trigger that the frame is filed under.
    pub own: u32,
    /// The number of places that vote for the other trigger.
    pub other: u32,
}

impl Votes {
    fn is_for_other(self) -> bool {
        self.other >= LEAST_PLACES && self.other >= TO_ONE * self.own
    }

    fn is_for_own(self) -> bool {
        self.own >= LEAST_PLACES && self.own >= TO_ONE * self.other
    }
}

/// The votes of other cameras on a frame, by the other trigger and the camera's place in the calibration.
pub type Evidence = BTreeMap<(u64, usize), Votes>;

/// The places of a camera's cloud that another camera has something near to at the same trigger: place, pixel of the
/// other camera, and how far from its surface, m.
fn seen<'a>(
    own: &'a Sketch,
    by: &'a Sketch,
    device: &'a Device,
) -> impl Iterator<Item = (&'a Point3<f32>, [usize; 2], f32)> {
    let centre = device.centre().cast::<f32>();
    own.places.iter().filter_map(move |cell| {
        let (place, normal) = own.cells[*cell as usize].as_ref()?;
        // A surface that faces away from the other camera is not seen by it.
        let faces = normal.dot(&(centre - place)) > 0.0;
        let pixel = device.project(&faces.then(|| place.cast())?).filter(|pixel| device.contains(*pixel))?;
        let pixel = pixel.map(|x| x.max(0.0) as usize);
        Some((place, pixel, by.distance_m(place, pixel)?))
    })
}

/// The votes of the other cameras on a camera's frame of a trigger; `sketches` by trigger. Votes without weight are
/// left out. `None` where no other camera of its head votes against it: the frame is of its own trigger, whatever
/// the votes on others are.
pub fn evidence_on(
    calibration: &Calibration,
    sketches: &BTreeMap<u64, Sketches>,
    trigger: u64,
    camera: usize,
) -> Option<Evidence> {
    let head = heads(calibration);
    let at_own = |place: usize| sketches.get(&trigger)?.get(place)?.as_ref();
    let own = at_own(camera)?;
    let others: Vec<(usize, &Device, &Sketch)> = calibration
        .cameras()
        .enumerate()
        .filter(|(other, _)| *other != camera)
        .filter_map(|(other, (_, seer))| Some((other, &seer.device, at_own(other)?)))
        .collect();
    let is_mate = |other: usize| head[other] == head[camera];
    let is_off = |&(_, device, by): &(usize, &Device, &Sketch)| {
        seen(own, by, device).filter(|(.., here)| *here > OFF_M).count() >= LEAST_PLACES as usize
    };
    // Nearly all frames have no such vote, and cost nothing more.
    others.iter().filter(|(other, ..)| is_mate(*other)).any(is_off).then_some(())?;
    let mut evidence = Evidence::new();
    for (other, device, by) in others {
        let near = sketches.range(trigger.saturating_sub(REACH)..=trigger.saturating_add(REACH));
        let near = near.filter(|(at, _)| **at != trigger);
        let near: Vec<(u64, &Sketch)> =
            near.filter_map(|(at, of)| Some((*at, of.get(other)?.as_ref()?))).collect();
        let mut votes = vec![Votes::default(); near.len()];
        for (place, pixel, here) in seen(own, by, device) {
            let (on, off) = (here < ON_M, here > OFF_M);
            for (votes, (_, at)) in votes.iter_mut().zip(&near).filter(|_| on || off) {
                let Some(there) = at.distance_m(place, pixel) else { continue };
                votes.own += u32::from(on && there > OFF_M);
                votes.other += u32::from(off && there < ON_M);
            }
        }
        evidence.extend(near.iter().zip(votes).map(|((at, _), votes)| ((*at, other), votes)));
    }
    evidence.retain(|_, votes| votes.is_for_other() || votes.is_for_own());
    evidence.iter().any(|((_, other), votes)| is_mate(*other) && votes.is_for_other()).then_some(evidence)
}

/// The frames of other triggers: trigger, place of the camera, and the trigger that they show.
pub type Strangers = BTreeMap<(u64, usize), u64>;

/// The head of each camera, by places in the calibration.
fn heads(calibration: &Calibration) -> Vec<usize> {
    let heads = calibration.heads.iter().enumerate();
    heads.flat_map(|(place, head)| head.cameras.iter().map(move |_| place)).collect()
}

/// Which frames are of another trigger than that they are filed under, by the votes on each. Two cameras of one head
/// cannot decide which of them is wrong: another head must vote the same, and no camera may vote for the frame's own
/// trigger. The votes of a stranger on others count no more; this is repeated until nothing changes.
pub fn strangers(calibration: &Calibration, evidence: &mut BTreeMap<(u64, usize), Evidence>) -> Strangers {
    let head = heads(calibration);
    let mut strangers = Strangers::new();
    loop {
        let shown = |(frame, evidence): (&(u64, usize), &Evidence)| {
            Some((*frame, shown_trigger(evidence, frame.1, &head)?))
        };
        let found: Strangers = evidence.par_iter().filter_map(shown).collect();
        if found.is_empty() {
            return strangers;
        }
        evidence.retain(|frame, _| !found.contains_key(frame));
        for ((trigger, _), evidence) in evidence.iter_mut() {
            // A stranger has voted by its places at the frame's trigger, and at the other one.
            evidence.retain(|(at, other), _| {
                !found.contains_key(&(*trigger, *other)) && !found.contains_key(&(*at, *other))
            });
        }
        strangers.extend(found);
    }
}

/// Frames that the other camera of the head votes to be of another trigger, while no camera votes for their own: the
/// same holds for each of the two, so that one of them is a stranger, without proof which.
pub fn suspects(calibration: &Calibration, evidence: &BTreeMap<(u64, usize), Evidence>) -> Strangers {
    let head = heads(calibration);
    let of = |((trigger, camera), evidence): (&(u64, usize), &Evidence)| {
        let against =
            evidence.iter().find(|((_, other), votes)| head[*other] == head[*camera] && votes.is_for_other());
        let ((at, _), _) = against?;
        let is_own = evidence.iter().any(|((of, _), votes)| of == at && votes.is_for_own());
        (!is_own).then_some(((*trigger, *camera), *at))
    };
    evidence.iter().filter_map(of).collect()
}

/// The trigger that a frame shows, where that is without doubt another one than its own.
fn shown_trigger(evidence: &Evidence, camera: usize, head: &[usize]) -> Option<u64> {
    let mut by_trigger: BTreeMap<u64, Vec<(usize, Votes)>> = BTreeMap::new();
    for ((at, other), votes) in evidence {
        by_trigger.entry(*at).or_default().push((*other, *votes));
    }
    let is_mate = |other: usize| head[other] == head[camera];
    let without_doubt = |votes: &[(usize, Votes)]| {
        let votes_for =
            |mate: bool| votes.iter().any(|(other, votes)| is_mate(*other) == mate && votes.is_for_other());
        votes_for(true) && votes_for(false) && !votes.iter().any(|(_, votes)| votes.is_for_own())
    };
    let weight = |votes: &[(usize, Votes)]| votes.iter().map(|(_, votes)| votes.other).sum::<u32>();
    let candidates = by_trigger.into_iter().filter(|(_, votes)| without_doubt(votes));
    candidates.max_by_key(|(at, votes)| (weight(votes), std::cmp::Reverse(*at))).map(|(at, _)| at)
}
