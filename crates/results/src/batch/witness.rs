// SPDX-License-Identifier: MIT OR Apache-2.0
//! The light as a witness of the trigger: a frame that is filed one trigger wrong shows the body where the others have it at another one.
//!
//! Places of a camera's cloud are looked for in the clouds of the other cameras, at its own trigger and at those near it. A place speaks
//! *against* a frame where it lies well off what another camera has at its own trigger, and on what that camera has at another one;
//! where it is the other way round, it speaks *for* it. Of a body that stands still no place says anything (docs/design/reconstruction.md,
//! "The light as a witness").

use crate::data::{Calibration, Cloud};
use crate::geometry::Device;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Triggers to each side that a frame may be of.
pub const REACH: u64 = 5;
/// One place in a cell of so many pixels squared.
const CELL_PX: usize = 8;
/// A place is off a surface that is so far away, m, and on one that is no further than this; between them it says nothing. Cameras that
/// differ by as much as `ON_M` contradict the calibration, and are refused before.
const OFF_M: f32 = 2e-3;
const ON_M: f32 = 1e-3;
/// A surface further away is another one, m.
const NEAR_M: f32 = 0.05;
/// A camera says something by so many places at least, of which so many speak one way for one that speaks the other way.
const LEAST_PLACES: u32 = 40;
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

/// Places that speak for a frame's own trigger, and against it for another one.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Votes {
    /// Places that speak for the trigger that the frame is filed under.
    pub own: u32,
    /// Places that speak for the other trigger.
    pub other: u32,
}

impl Votes {
    fn says_other(self) -> bool {
        self.other >= LEAST_PLACES && self.other >= TO_ONE * self.own
    }

    fn says_own(self) -> bool {
        self.own >= LEAST_PLACES && self.own >= TO_ONE * self.other
    }
}

/// What other cameras say of a frame, by the other trigger and the camera's place in the calibration.
pub type Said = BTreeMap<(u64, usize), Votes>;

/// The places of a camera's cloud that another camera has something near to at the same trigger: place, pixel of the other camera, and
/// how far from its surface, m.
fn seen<'a>(
    own: &'a Sketch,
    by: &'a Sketch,
    device: &'a Device,
) -> impl Iterator<Item = (&'a Point3<f32>, [usize; 2], f32)> {
    let centre = device.centre().cast::<f32>();
    own.places.iter().filter_map(move |cell| {
        let (place, normal) = own.cells[*cell as usize].as_ref()?;
        // What turns away from the other camera is not seen by it.
        let faces = normal.dot(&(centre - place)) > 0.0;
        let pixel = device.project(&faces.then(|| place.cast())?).filter(|pixel| device.contains(*pixel))?;
        let pixel = pixel.map(|x| x.max(0.0) as usize);
        Some((place, pixel, by.distance_m(place, pixel)?))
    })
}

/// What the other cameras say of a camera's frame of a trigger; `sketches` by trigger. What is of no weight is left out. `None` where no
/// other camera of its head speaks against it: the frame is of its own trigger, whatever is said of others.
pub fn ask(
    calibration: &Calibration,
    sketches: &BTreeMap<u64, Sketches>,
    trigger: u64,
    camera: usize,
) -> Option<Said> {
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
    // Nearly all frames end here.
    others.iter().filter(|(other, ..)| is_mate(*other)).any(is_off).then_some(())?;
    let mut said = Said::new();
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
        said.extend(near.iter().zip(votes).map(|((at, _), votes)| ((*at, other), votes)));
    }
    said.retain(|_, votes| votes.says_other() || votes.says_own());
    said.iter().any(|((_, other), votes)| is_mate(*other) && votes.says_other()).then_some(said)
}

/// The frames of other triggers: trigger, place of the camera, and the trigger that they show.
pub type Strangers = BTreeMap<(u64, usize), u64>;

/// The head of each camera, by places in the calibration.
fn heads(calibration: &Calibration) -> Vec<usize> {
    let heads = calibration.heads.iter().enumerate();
    heads.flat_map(|(place, head)| head.cameras.iter().map(move |_| place)).collect()
}

/// Which frames are of another trigger than that they are filed under, by what is said of each. Two cameras of one head cannot tell
/// which of them is wrong: another head must say the same, and no camera may say that the frame is of its own trigger. What a
/// stranger says of others counts no more, until nothing changes.
pub fn strangers(calibration: &Calibration, said: &mut BTreeMap<(u64, usize), Said>) -> Strangers {
    let head = heads(calibration);
    let mut strangers = Strangers::new();
    loop {
        let shown =
            |(frame, said): (&(u64, usize), &Said)| Some((*frame, shown_trigger(said, frame.1, &head)?));
        let found: Strangers = said.par_iter().filter_map(shown).collect();
        if found.is_empty() {
            return strangers;
        }
        said.retain(|frame, _| !found.contains_key(frame));
        for ((trigger, _), said) in said.iter_mut() {
            // By its places at the frame's trigger and at the other one it has spoken.
            said.retain(|(at, other), _| {
                !found.contains_key(&(*trigger, *other)) && !found.contains_key(&(*at, *other))
            });
        }
        strangers.extend(found);
    }
}

/// Frames of which the other camera of the head says that they are of another trigger, while nobody says that they are of their own:
/// the same of each of the two, so that one of them is a stranger, and nobody knows which.
pub fn suspects(calibration: &Calibration, said: &BTreeMap<(u64, usize), Said>) -> Strangers {
    let head = heads(calibration);
    let of = |((trigger, camera), said): (&(u64, usize), &Said)| {
        let against =
            said.iter().find(|((_, other), votes)| head[*other] == head[*camera] && votes.says_other());
        let ((at, _), _) = against?;
        let is_own = said.iter().any(|((of, _), votes)| of == at && votes.says_own());
        (!is_own).then_some(((*trigger, *camera), *at))
    };
    said.iter().filter_map(of).collect()
}

/// The trigger that a frame shows, where that is without doubt another one than its own.
fn shown_trigger(said: &Said, camera: usize, head: &[usize]) -> Option<u64> {
    let mut by_trigger: BTreeMap<u64, Vec<(usize, Votes)>> = BTreeMap::new();
    for ((at, other), votes) in said {
        by_trigger.entry(*at).or_default().push((*other, *votes));
    }
    let is_mate = |other: usize| head[other] == head[camera];
    let without_doubt = |votes: &[(usize, Votes)]| {
        let says =
            |mate: bool| votes.iter().any(|(other, votes)| is_mate(*other) == mate && votes.says_other());
        says(true) && says(false) && !votes.iter().any(|(_, votes)| votes.says_own())
    };
    let weight = |votes: &[(usize, Votes)]| votes.iter().map(|(_, votes)| votes.other).sum::<u32>();
    let candidates = by_trigger.into_iter().filter(|(_, votes)| without_doubt(votes));
    candidates.max_by_key(|(at, votes)| (weight(votes), std::cmp::Reverse(*at))).map(|(at, _)| at)
}
