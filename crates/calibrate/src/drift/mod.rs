// SPDX-License-Identifier: MIT OR Apache-2.0
//! How far each device of a rig has turned since it was calibrated, from phase maps of whatever stood in the volume.
//!
//! Where two cameras see one place, the phase of the first camera gives the place in space. The phase of the second
//! camera must then be the one that its projector casts there. Devices turn about their centres by small angles. The
//! angles that explain the differences best are found by weighted least squares (Gauss and Newton's steps, Cauchy's
//! weights).
//!
//! Each angle is 0 beforehand, with a standard deviation of [`PRIOR_DEG`]. A turn that the body does not determine
//! therefore stays near 0, with a large uncertainty.

pub mod history;
mod plot;
mod sightings;
#[cfg(test)]
mod tests;

use crate::data::{Calibration, PhaseMap};
use crate::estimate::median;
use crate::geometry::{Device, Pose};
use history::Verdict;
use nalgebra::{DMatrix, DVector, UnitQuaternion, Vector3};
use serde::Serialize;
use sightings::{Sighting, distance, place};
use std::fmt;

/// Standard deviation of each angle beforehand, degree: what mounts turn by, as a rule.
const PRIOR_DEG: f64 = 0.01;

/// Neighbouring places have common errors: standard deviations are this many times those of independent places.
const ALIKE: f64 = 5.0;

/// Least scatter that the differences of two cameras are taken to have, rad.
const LEAST_SCALE_RAD: f64 = 0.01;

/// Steps of the search, each with weights from the differences that the last one left.
const ROUNDS: usize = 6;

/// Fewest places from which the turns of a rig are estimated.
const LEAST_SIGHTINGS: usize = 500;

/// Most places that are used, evenly spread: more add nothing but time.
const MOST_SIGHTINGS: usize = 60_000;

/// A move is certain when it is this many times its own standard deviation.
const SURE: f64 = 4.0;

/// A device is not known when this many standard deviations are more than its limit.
const UNSURE: f64 = 2.0;

/// A device counts as turned from this share of its limit on.
const TURNED_SHARE: f64 = 0.5;

/// Angle by which devices are turned to differentiate numerically, rad.
const STEP_RAD: f64 = 1e-5;

/// By how much one device has turned about its centre.
#[derive(Debug, Clone, Serialize)]
pub struct Turn {
    /// `camera h0_up` or `projector h0`.
    pub device: String,
    /// About its own axes, degree.
    pub turn_deg: [f64; 3],
    /// Standard deviations of these, degree.
    pub sigma_deg: [f64; 3],
    pub angle_deg: f64,
    /// How far that moves what it sees in the middle of the volume, or what a projector lights there, across its
    /// fringes, mm.
    pub at_body_mm: f64,
    /// Standard deviation of that, mm.
    pub at_body_sigma_mm: f64,
}

impl fmt::Display for Turn {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { device, angle_deg, at_body_mm, at_body_sigma_mm, .. } = self;
        write!(
            f,
            "{device} has turned by {angle_deg:.3} degree, {at_body_mm:.2} (+- {at_body_sigma_mm:.2}) mm at the body"
        )
    }
}

/// How far all devices of a rig have turned, as the cameras of a session show it. `estimate` makes it from phase maps.
#[derive(Debug, Clone, Serialize)]
pub struct Drift {
    /// Cameras in the calibration's order, then projectors.
    pub devices: Vec<Turn>,
    /// Places that two cameras see.
    pub sightings: usize,
    /// How far the two differ there (1.4826 times the median): by the calibration, and with these turns, rad.
    pub differ_rad: [f64; 2],
}

impl Drift {
    /// The devices that have certainly moved what they see by more than `most_mm`.
    pub fn moved(&self, most_mm: f64) -> Vec<&Turn> {
        let sure = |turn: &&Turn| turn.at_body_mm > SURE * turn.at_body_sigma_mm;
        self.devices.iter().filter(|turn| turn.at_body_mm > most_mm).filter(sure).collect()
    }

    /// The verdict where a device may move what it sees by `most_mm`, and the same in a sentence.
    pub fn verdict(&self, most_mm: f64) -> (Verdict, String) {
        let far = |a: &&Turn, b: &&Turn| a.at_body_mm.total_cmp(&b.at_body_mm);
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
        let vague = |turn: &Turn| UNSURE * turn.at_body_sigma_mm > most_mm;
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
                let furthest = furthest.map_or_else(String::new, |x| format!("; the most is: {x}"));
                (Verdict::Stands, format!("no device has moved by half the limit of {most_mm} mm{furthest}"))
            }
        }
    }

    /// These turns counted from another calibration, from which `corrected` came step by step. Uncertainties are those
    /// of the last step.
    pub fn since(mut self, first: &Calibration, corrected: &Calibration, first_rad: f64) -> Self {
        let (from, to) = (Search::new(first), Search::new(corrected));
        for (i, device) in self.devices.iter_mut().enumerate() {
            let [a, b] = [&from, &to].map(|x| x.devices[i].world_from_device.isometry().rotation);
            let sigma = device.sigma_deg.map(f64::to_radians);
            *device = from.turn(i, &(a.inverse() * b).scaled_axis(), &sigma);
        }
        self.differ_rad[0] = first_rad;
        self
    }

    /// The calibration with these turns; its origin names the session they were seen in.
    pub fn corrected(&self, calibration: &Calibration, seen_in: &str) -> Calibration {
        let mut corrected = calibration.clone();
        let mut turns = self.devices.iter().map(|device| Vector3::from(device.turn_deg.map(f64::to_radians)));
        for camera in corrected.heads.iter_mut().flat_map(|head| &mut head.cameras) {
            camera.device = turned(&camera.device, &turns.next().unwrap_or_default());
        }
        for head in &mut corrected.heads {
            head.projector = turned(&head.projector, &turns.next().unwrap_or_default());
        }
        corrected.origin = format!("{}; corrected for the turns seen in {seen_in}", calibration.origin);
        corrected
    }
}

/// A device turned about its centre, about its own axes, rad.
fn turned(device: &Device, turn: &Vector3<f64>) -> Device {
    let mut pose = *device.world_from_device.isometry();
    pose.rotation *= UnitQuaternion::from_scaled_axis(*turn);
    Device { world_from_device: Pose::new(pose), ..device.clone() }
}

/// The devices as they would stand, with each turned a little about each axis, both ways.
struct Stand {
    now: Vec<Device>,
    beside: Vec<[[Device; 2]; 3]>,
}

impl Stand {
    fn new(devices: &[Device], turns: &[Vector3<f64>]) -> Self {
        let now: Vec<Device> = devices.iter().zip(turns).map(|(device, turn)| turned(device, turn)).collect();
        let beside = |device: &Device| {
            [Vector3::x(), Vector3::y(), Vector3::z()]
                .map(|axis| [axis * STEP_RAD, -axis * STEP_RAD].map(|turn| turned(device, &turn)))
        };
        Self { beside: now.iter().map(beside).collect(), now }
    }
}

/// The drift that the phase maps of some instants show. Maps by their camera's place in the calibration.
///
/// # Errors
///
/// Too few places are seen by two cameras.
pub fn estimate(
    calibration: &Calibration,
    instants: impl Iterator<Item = Vec<(usize, PhaseMap)>>,
) -> Result<Drift, String> {
    let mut sightings: Vec<Sighting> = Vec::new();
    for maps in instants {
        sightings.extend(sightings::of(calibration, &maps));
    }
    if sightings.len() < LEAST_SIGHTINGS {
        return Err(format!(
            "expected {LEAST_SIGHTINGS} places and more that two cameras see, found {}: record a body that fills the volume",
            sightings.len()
        ));
    }
    let every = sightings.len().div_ceil(MOST_SIGHTINGS);
    let sightings: Vec<Sighting> = sightings.into_iter().step_by(every).collect();
    Ok(Search::new(calibration).run(&sightings))
}

struct Search<'a> {
    calibration: &'a Calibration,
    /// All cameras of the calibration, then its projectors.
    devices: Vec<Device>,
    /// Of each camera, its projector's place among the devices.
    projector: Vec<usize>,
}

impl<'a> Search<'a> {
    fn new(calibration: &'a Calibration) -> Self {
        let cameras = calibration.cameras().count();
        let devices = calibration.cameras().map(|(_, camera)| &camera.device);
        let devices = devices.chain(calibration.heads.iter().map(|head| &head.projector));
        let heads = calibration.heads.iter().enumerate();
        let projector = heads.flat_map(|(h, head)| head.cameras.iter().map(move |_| cameras + h));
        Self { calibration, devices: devices.cloned().collect(), projector: projector.collect() }
    }

    /// The devices that a sighting depends on: its camera and that one's projector, the other camera and that one's.
    fn of(&self, s: &Sighting) -> [usize; 4] {
        [s.camera, self.projector[s.camera], s.other, self.projector[s.other]]
    }

    /// By how much the other camera differs, rad, where the devices stand so.
    fn difference(
        &self,
        s: &Sighting,
        [camera, projector, other, its_projector]: [&Device; 4],
    ) -> Option<f64> {
        let column = self.calibration.pattern.column(s.phase);
        let distance_m = distance(camera, projector, &s.sight, column, s.distance_m)?;
        let point = place(camera, &s.sight, distance_m);
        let [u, v] = other.project(&point)?;
        let seen = s.other_phase + s.other_slope[0] * (u - s.at[0]) + s.other_slope[1] * (v - s.at[1]);
        let [column, _] = its_projector.project(&point)?;
        Some(seen - self.calibration.pattern.phase(column))
    }

    /// How it changes with each turn of each of its devices, rad/rad. A projector that both have is one device.
    fn slopes(&self, s: &Sighting, stand: &Stand) -> Option<Vec<(usize, f64)>> {
        let of = self.of(s);
        let mut distinct = of.to_vec();
        distinct.sort_unstable();
        distinct.dedup();
        let mut slopes = Vec::with_capacity(12);
        for device in distinct {
            for axis in 0..3 {
                let at = |way: usize| {
                    let stands =
                        |i: usize| if i == device { &stand.beside[i][axis][way] } else { &stand.now[i] };
                    self.difference(s, of.map(stands))
                };
                slopes.push((3 * device + axis, (at(0)? - at(1)?) / (2.0 * STEP_RAD)));
            }
        }
        Some(slopes)
    }

    fn differences(&self, sightings: &[Sighting], devices: &[Device]) -> Vec<Option<f64>> {
        sightings.iter().map(|s| self.difference(s, self.of(s).map(|i| &devices[i]))).collect()
    }

    fn run(&self, sightings: &[Sighting]) -> Drift {
        let n = 3 * self.devices.len();
        let prior = PRIOR_DEG.to_radians().powi(-2);
        let mut turns = vec![Vector3::zeros(); self.devices.len()];
        let mut sigma = DVector::zeros(n);
        let before = scale(&self.differences(sightings, &self.devices));
        for _ in 0..ROUNDS {
            let stand = Stand::new(&self.devices, &turns);
            let differences = self.differences(sightings, &stand.now);
            let scale = scale(&differences);
            let (mut matrix, mut right) = (DMatrix::zeros(n, n), DVector::zeros(n));
            for (s, difference) in sightings.iter().zip(differences) {
                let Some((difference, slopes)) = difference.zip(self.slopes(s, &stand)) else { continue };
                let robust = 1.0 / (1.0 + (difference / (2.0 * scale)).powi(2));
                let weight = robust / (ALIKE * scale).powi(2);
                for &(i, a) in &slopes {
                    right[i] -= weight * a * difference;
                    for &(k, b) in &slopes {
                        matrix[(i, k)] += weight * a * b;
                    }
                }
            }
            for i in 0..n {
                matrix[(i, i)] += prior;
                right[i] -= prior * turns[i / 3][i % 3];
            }
            let Some(factor) = matrix.cholesky() else { break };
            let step = factor.solve(&right);
            (0..n).for_each(|i| turns[i / 3][i % 3] += step[i]);
            sigma = factor.inverse().diagonal().map(f64::sqrt);
        }
        let after = scale(&self.differences(sightings, &Stand::new(&self.devices, &turns).now));
        Drift {
            devices: (0..turns.len()).map(|i| self.turn(i, &turns[i], &sigma.as_slice()[3 * i..])).collect(),
            sightings: sightings.len(),
            differ_rad: [before, after],
        }
    }

    fn turn(&self, device: usize, turn: &Vector3<f64>, sigma: &[f64]) -> Turn {
        let cameras = self.projector.len();
        let name = match self.calibration.cameras().nth(device) {
            Some((_, camera)) => format!("camera {}", camera.id),
            None => format!("projector {}", self.calibration.heads[device - cameras].id),
        };
        let (min, max) = (self.calibration.volume_min_m, self.calibration.volume_max_m);
        let middle = (Vector3::from(min) + Vector3::from(max)) / 2.0;
        let from = self.devices[device].world_from_device.isometry().inverse_transform_point(&middle.into());
        // A projector whose light moves along its fringes changes no phase, and so no point.
        let matters = |shift: Vector3<f64>| if device < cameras { shift.norm() } else { shift.x.abs() };
        let axes = [Vector3::x(), Vector3::y(), Vector3::z()];
        let sigmas = axes.iter().zip(sigma).map(|(axis, sigma)| matters(axis.cross(&from.coords)) * sigma);
        Turn {
            device: name,
            turn_deg: (*turn).map(f64::to_degrees).into(),
            sigma_deg: std::array::from_fn(|axis| sigma[axis].to_degrees()),
            angle_deg: turn.norm().to_degrees(),
            at_body_mm: matters(turn.cross(&from.coords)) * 1e3,
            at_body_sigma_mm: sigmas.map(|x| x * x).sum::<f64>().sqrt() * 1e3,
        }
    }
}

/// 1.4826 times the median of the sizes, rad.
fn scale(differences: &[Option<f64>]) -> f64 {
    // Without any differences this is the least: `max` leaves out NaN.
    (1.4826 * median(differences.iter().flatten().map(|x| x.abs()))).max(LEAST_SCALE_RAD)
}
