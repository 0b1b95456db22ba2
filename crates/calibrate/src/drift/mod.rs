// SPDX-License-Identifier: MIT OR Apache-2.0
//! How far each device of a rig has moved since it was calibrated, from phase maps of whatever stood in the volume.
//!
//! Where two cameras see one place, the phase of the first camera gives the place in space. The phase of the second
//! camera must then be the one that its projector casts there. A device may have turned, shifted, or changed its focal
//! length; a head may have moved as a whole. [`search`] chooses which of these happened and by how much. Places that
//! took no part judge whether the calibration with these moves is a better one.

mod at_body;
pub mod history;
mod motion;
mod plot;
mod search;
mod sightings;
#[cfg(test)]
mod tests;

use crate::data::{Calibration, PhaseMap};
use history::Verdict;
use motion::Motion;
use search::Search;
use serde::Serialize;
use sightings::Sighting;
use std::fmt;

/// Fewest places from which the moves of a rig are estimated.
const LEAST_SIGHTINGS: usize = 500;

/// Most places that are used, evenly spread: more add nothing but time.
const MOST_SIGHTINGS: usize = 60_000;

/// Cameras whose phases differ by less, rad, are near enough to the calibration for the moves to be trusted.
const NEAR_RAD: f64 = 0.1;

/// Moves that change by less than this from one reconstruction to the next are found, in units of what mounts usually move
/// by: some 0.06 mm at the body.
const SETTLED: f64 = 0.2;

/// A move is certain when it is this many times its own standard deviation.
const SURE: f64 = 4.0;

/// A device is not known when this many standard deviations are more than its limit.
const UNSURE: f64 = 2.0;

/// A device counts as moved a little from this share of its limit on: of the usual 0.2 mm that is the error of a frame's
/// points (robust) with a calibration that stands.
const TURNED_SHARE: f64 = 0.25;

/// How a device has moved.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// It has turned about its centre.
    Turn,
    /// Its centre has another place.
    Shift,
    /// Its focal length has changed.
    FocalLength,
    /// A head has moved with all that is on it.
    Whole,
}

/// By how much one device, or one head, has moved. Axes are its own; those of a head are the world's.
#[derive(Debug, Clone, Serialize)]
pub struct Move {
    /// `camera h0_up`, `projector h0` or `head h0`.
    pub device: String,
    /// What has happened to it; nothing where all its numbers are 0.
    pub kinds: Vec<Kind>,
    /// About x, y and z, degree.
    pub turn_deg: [f64; 3],
    /// Standard deviations of these, degree.
    pub sigma_deg: [f64; 3],
    pub angle_deg: f64,
    /// Along x, y and z, mm.
    pub shift_mm: [f64; 3],
    /// Standard deviations of these, mm.
    pub shift_sigma_mm: [f64; 3],
    /// By how much the focal length is longer, %.
    pub focal_percent: f64,
    /// Standard deviation of that, %.
    pub focal_sigma_percent: f64,
    /// How far that moves what it sees of the body, or what a projector lights there across its fringes (RMS over the
    /// body), mm.
    pub at_body_mm: f64,
    /// Standard deviation of that, mm.
    pub at_body_sigma_mm: f64,
}

impl fmt::Display for Move {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { device, angle_deg, focal_percent, at_body_mm, at_body_sigma_mm, .. } = self;
        let shift_mm = self.shift_mm.iter().map(|x| x * x).sum::<f64>().sqrt();
        let turned = format!("has turned by {angle_deg:.3} degree");
        let shifted = format!("has shifted by {shift_mm:.2} mm");
        let words: Vec<String> = self
            .kinds
            .iter()
            .map(|kind| match kind {
                Kind::Turn => turned.clone(),
                Kind::Shift => shifted.clone(),
                Kind::FocalLength => format!("has a focal length that differs by {focal_percent:+.3} %"),
                Kind::Whole => format!("{turned} and {shifted} as a whole"),
            })
            .collect();
        let words = if words.is_empty() { "has not moved".to_owned() } else { words.join(" and ") };
        write!(f, "{device} {words}, {at_body_mm:.2} (+- {at_body_sigma_mm:.2}) mm at the body")
    }
}

/// How far cameras differ at places from which no move was estimated.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Judged {
    pub places: usize,
    /// Root mean square of the differences, large ones cut, by the calibration and with the moves, rad.
    pub differ_rad: [f64; 2],
    /// Cameras that differ more with the moves than without.
    pub worse: Vec<String>,
    /// Cameras of which too few places are seen to tell.
    pub unseen: Vec<String>,
}

/// How far all devices of a rig have moved, as the cameras of a session show it. `estimate` makes it from phase maps.
#[derive(Debug, Clone, Serialize)]
pub struct Drift {
    /// Cameras in the calibration's order, then projectors, then heads that have moved as a whole.
    pub devices: Vec<Move>,
    /// Places that two cameras see.
    pub sightings: usize,
    /// How far the two differ there (1.4826 times the median): by the calibration, and with these moves, rad.
    pub differ_rad: [f64; 2],
    pub held_back: Judged,
    /// The motion of each device, those of its head included.
    #[serde(skip)]
    motions: Vec<Motion>,
    /// How far the two differ as the devices were thought to stand when the places were found, rad.
    #[serde(skip)]
    pub started_rad: f64,
    /// By how much a device's motion differs from how it was thought to stand then, at most, in units of [`motion::USUAL`].
    #[serde(skip)]
    changed: f64,
}

impl Drift {
    /// The devices that have certainly moved what they see by more than `most_mm`.
    pub fn moved(&self, most_mm: f64) -> Vec<&Move> {
        let sure = |x: &&Move| x.at_body_mm > SURE * x.at_body_sigma_mm;
        self.devices.iter().filter(|x| x.at_body_mm > most_mm).filter(sure).collect()
    }

    /// The verdict where a device may move what it sees by `most_mm`, and the same in a sentence.
    pub fn verdict(&self, most_mm: f64) -> (Verdict, String) {
        let far = |a: &&Move, b: &&Move| a.at_body_mm.total_cmp(&b.at_body_mm);
        let moved = self.moved(most_mm);
        if let Some(furthest) = moved.iter().copied().max_by(far) {
            let others = match moved.len() - 1 {
                0 => String::new(),
                n => format!(" ({n} more by less)"),
            };
            return (
                Verdict::CalibrateAgain,
                format!("calibrate again: {furthest}{others}; the limit is {most_mm} mm"),
            );
        }
        let vague = |x: &Move| UNSURE * x.at_body_sigma_mm > most_mm;
        let vague: Vec<&str> = self.devices.iter().filter(|x| vague(x)).map(|x| x.device.as_str()).collect();
        if !vague.is_empty() {
            let which = vague.join(", ");
            let sentence = format!(
                "the session cannot show a move of {most_mm} mm of {which}: record a body that all heads see"
            );
            return (Verdict::NotKnown, sentence);
        }
        match self.devices.iter().max_by(far) {
            Some(furthest) if furthest.at_body_mm > TURNED_SHARE * most_mm => {
                (Verdict::Turned, format!("{furthest}; the limit is {most_mm} mm"))
            }
            furthest => {
                let moved = furthest.filter(|x| !x.kinds.is_empty());
                let moved = moved.map_or_else(String::new, |x| format!("; the most is: {x}"));
                (
                    Verdict::Stands,
                    format!("no device has moved by a quarter of the limit of {most_mm} mm{moved}"),
                )
            }
        }
    }

    /// The calibration with these moves; its origin names the session they were seen in.
    pub fn corrected(&self, calibration: &Calibration, seen_in: &str) -> Calibration {
        let mut corrected = calibration.clone();
        let mut motions = self.motions.iter().copied();
        for camera in corrected.heads.iter_mut().flat_map(|head| &mut head.cameras) {
            camera.device = motions.next().unwrap_or_default().apply(&camera.device);
        }
        for head in &mut corrected.heads {
            head.projector = motions.next().unwrap_or_default().apply(&head.projector);
        }
        corrected.origin = format!("{}; corrected for the moves seen in {seen_in}", calibration.origin);
        corrected
    }

    /// Whether the places were found with devices that nearly stood where they do.
    pub fn is_near(&self) -> bool {
        self.started_rad < NEAR_RAD
    }

    /// Whether another reconstruction, with these moves, would find the same.
    pub fn is_settled(&self) -> bool {
        self.is_near() && self.changed < SETTLED
    }

    /// Why the corrected calibration is not known to be a better one, if it is not.
    pub fn no_better(&self) -> Option<String> {
        let Judged { places, differ_rad: [before, after], worse, unseen } = &self.held_back;
        let judged = format!("at {places} places that took no part cameras differ by");
        if self.devices.iter().all(|x| x.kinds.is_empty()) {
            return Some(format!("no move explains how cameras differ; {judged} {before:.3} rad"));
        }
        if !unseen.is_empty() {
            return Some(format!("too few places show how these stand: {}", unseen.join(", ")));
        }
        let which = if worse.is_empty() { String::new() } else { format!(", more: {}", worse.join(", ")) };
        let better = after < before && worse.is_empty();
        (!better).then(|| {
            format!("{judged} {before:.3} rad by the calibration, {after:.3} rad with the moves{which}")
        })
    }
}

/// The drift that the phase maps of some instants show. Maps by their camera's place in the calibration. They were made
/// with the calibration as `known` corrects it.
///
/// # Errors
///
/// Too few places are seen by two cameras.
pub fn estimate(
    calibration: &Calibration,
    known: Option<&Drift>,
    instants: impl Iterator<Item = Vec<(usize, PhaseMap)>>,
) -> Result<Drift, String> {
    let made_with = known.map(|known| known.corrected(calibration, ""));
    let mut sightings: Vec<Sighting> = Vec::new();
    for (instant, maps) in instants.enumerate() {
        sightings.extend(sightings::of(made_with.as_ref().unwrap_or(calibration), instant, &maps));
    }
    if sightings.len() < LEAST_SIGHTINGS {
        return Err(format!(
            "expected {LEAST_SIGHTINGS} places and more that two cameras see, found {}: record a body that fills the volume",
            sightings.len()
        ));
    }
    let every = sightings.len().div_ceil(MOST_SIGHTINGS);
    let sightings: Vec<Sighting> = sightings.into_iter().step_by(every).collect();
    let search = Search::new(calibration);
    let still = vec![Motion::default(); search.devices.len()];
    Ok(search.run(&sightings, known.map_or(&still, |known| &known.motions)))
}
