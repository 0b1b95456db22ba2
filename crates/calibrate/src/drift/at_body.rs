// SPDX-License-Identifier: MIT OR Apache-2.0
//! What moves of devices come to at the body: how far each moves what it sees, how certain that is, and whether cameras agree
//! better with them at places that took no part.

use super::motion::{Motion, NUMBERS};
use super::search::{Search, Sums, Unit, scale, whole};
use super::sightings::{Sighting, place, sight};
use super::{Judged, Kind, Move};
use crate::geometry::Device;
use nalgebra::{DMatrix, DVector, Point3, Vector3};

/// Places at which it is measured how far a device has moved what it sees.
const BODY_PLACES: usize = 200;

/// Places that were held back, of one camera, from which it can be known that a correction makes it no worse.
const JUDGED_PLACES: usize = 30;

/// Differences count as this many times their scale at most, where a correction is judged: beyond are other surfaces.
const MOST_SCALES: f64 = 5.0;

/// By this share, and by this many rad, cameras may differ more with a correction than without.
const NO_WORSE: (f64, f64) = (1.05, 0.002);

impl Search<'_> {
    /// Every device, and the heads that have moved as a whole.
    pub(super) fn moves(
        &self,
        sightings: &[Sighting],
        sums: &Sums,
        chosen: &[usize],
        found: &DVector<f64>,
    ) -> Vec<Move> {
        // What has moved is as certain as the chosen moves make it; of what has not, it is asked whether it could have turned.
        let turns =
            (0..self.blocks.len()).filter(|i| self.blocks[*i].kind == Kind::Turn && !chosen.contains(i));
        let every: Vec<usize> = chosen.iter().copied().chain(turns).collect();
        let covariance = |blocks: &[usize]| sums.solve(&self.columns(blocks)).map(|x| x.0.inverse());
        let [of_chosen, of_every] = [chosen, &every].map(covariance);
        let mut moves = Vec::new();
        for (i, unit) in self.units.iter().enumerate() {
            let is_chosen = chosen.iter().any(|&k| self.blocks[k].unit == i);
            if unit.devices.len() > 1 && !is_chosen {
                continue;
            }
            let (set, covariance) = if is_chosen { (chosen, &of_chosen) } else { (&every[..], &of_every) };
            let mut own = DMatrix::zeros(NUMBERS, self.columns(set).len());
            let mut numbers = [0.0; NUMBERS];
            let mut at = 0;
            for block in set.iter().map(|&k| &self.blocks[k]) {
                for (k, number) in block.numbers.clone().enumerate() {
                    if block.unit == i {
                        own[(number, at + k)] = 1.0;
                        numbers[number] = found[block.column + k];
                    }
                }
                at += block.numbers.len();
            }
            let Some(covariance) = covariance else { continue };
            let covariance = &own * covariance * own.transpose();
            let kinds = chosen.iter().map(|&k| &self.blocks[k]).filter(|block| block.unit == i);
            let kinds = kinds.map(|block| block.kind).collect();
            moves.push(self.one_move(unit, kinds, &numbers, &covariance, sightings));
        }
        moves
    }

    fn one_move(
        &self,
        unit: &Unit,
        kinds: Vec<Kind>,
        numbers: &[f64; NUMBERS],
        covariance: &DMatrix<f64>,
        sightings: &[Sighting],
    ) -> Move {
        let mine = |s: &&Sighting| unit.devices.iter().any(|i| self.of(s)[..2].contains(i));
        let seen: Vec<&Sighting> = sightings.iter().filter(mine).collect();
        let every = seen.len().div_ceil(BODY_PLACES).max(1);
        let place = |s: &&Sighting| {
            let camera = &self.devices[s.camera];
            Some(place(camera, &sight(camera, s.pixel)?, s.distance_m))
        };
        let mut places: Vec<Point3<f64>> = seen.iter().step_by(every).filter_map(place).collect();
        if places.is_empty() {
            let (min, max) = (self.calibration.volume_min_m, self.calibration.volume_max_m);
            places.push(Point3::from((Vector3::from(min) + Vector3::from(max)) / 2.0));
        }
        let x = DVector::from_row_slice(numbers);
        let (mut size, mut variance) = (0.0, 0.0);
        for effect in places.iter().map(|place| self.at_place(unit, place)) {
            size += (&effect * &x).norm_squared() / places.len() as f64;
            variance += (&effect * covariance * effect.transpose()).trace() / places.len() as f64;
        }
        let motion = Motion::of(numbers);
        let sigma: [f64; NUMBERS] = std::array::from_fn(|i| covariance[(i, i)].max(0.0).sqrt());
        let sigma = Motion::of(&sigma);
        Move {
            device: unit.name.clone(),
            kinds,
            turn_deg: motion.turn.map(f64::to_degrees).into(),
            sigma_deg: sigma.turn.map(f64::to_degrees).into(),
            angle_deg: motion.turn.norm().to_degrees(),
            shift_mm: (motion.shift_m * 1e3).into(),
            shift_sigma_mm: (sigma.shift_m * 1e3).into(),
            focal_percent: motion.focal * 100.0,
            focal_sigma_percent: sigma.focal * 100.0,
            at_body_mm: size.sqrt() * 1e3,
            at_body_sigma_mm: variance.sqrt() * 1e3,
        }
    }

    /// How far each number of a unit moves what it sees, or lights, at a place, m.
    fn at_place(&self, unit: &Unit, place: &Point3<f64>) -> DMatrix<f64> {
        let &[i] = &unit.devices[..] else {
            // The points of a whole head move with it.
            let columns = (0..NUMBERS).map(|number| {
                let (turn, shift) = whole(number);
                turn.cross(&(place - unit.centre)) + shift
            });
            return DMatrix::from_iterator(3, NUMBERS, columns.flat_map(|x| [x.x, x.y, x.z]));
        };
        let device = &self.devices[i];
        // A projector whose light moves along its fringes changes no phase, and so no point.
        let both = if i < self.projector.len() { 1.0 } else { 0.0 };
        let m_per_px = device.device_point(place).z / device.lens.fx;
        let columns = (0..NUMBERS).map(|number| {
            let [from, to] = [device.project(place), Motion::unit(number).apply(device).project(place)];
            from.zip(to)
                .map_or([0.0; 2], |([u, v], [u2, v2])| [(u2 - u) * m_per_px, both * (v2 - v) * m_per_px])
        });
        DMatrix::from_iterator(2, NUMBERS, columns.flatten())
    }

    /// How far the cameras differ at the places that took no part, by the calibration and with the moves.
    pub(super) fn judge(&self, held_back: &[Sighting], devices: &[Vec<Device>; 2]) -> Judged {
        let [before, after] = devices.each_ref().map(|at| self.differences(held_back, at));
        let most = MOST_SCALES * scale(before.iter().flatten().copied());
        let of = |seen_by: &dyn Fn(&Sighting) -> bool| {
            let of = held_back.iter().zip(before.iter().zip(&after)).filter(|(s, _)| seen_by(s));
            let (before, after): (Vec<f64>, Vec<f64>) = of.filter_map(|(_, (a, b))| a.zip(*b)).unzip();
            let rms = |x: &[f64]| {
                let sum: f64 = x.iter().map(|x| x.abs().min(most).powi(2)).sum();
                (sum / x.len().max(1) as f64).sqrt()
            };
            (before.len(), [rms(&before), rms(&after)])
        };
        let (mut worse, mut unseen) = (Vec::new(), Vec::new());
        for (camera, unit) in self.units[..self.projector.len()].iter().enumerate() {
            let (places, [before, after]) = of(&|s| s.camera == camera || s.other == camera);
            if places < JUDGED_PLACES {
                unseen.push(unit.name.clone());
            } else if after > before * NO_WORSE.0 + NO_WORSE.1 {
                worse.push(unit.name.clone());
            }
        }
        let (places, differ_rad) = of(&|_| true);
        Judged { places, differ_rad, worse, unseen }
    }
}
