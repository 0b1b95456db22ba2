// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which devices have moved and how: the likeliest of all sets of moves, by Gauss and Newton's steps with Cauchy's
//! weights.
//!
//! A move is a turn, a shift or a focal length of one device, or a turn and a shift of a whole head. Its numbers are 0
//! beforehand, with standard deviations [`USUAL`]. Of two sets of moves that one is better whose evidence is greater: the
//! likelihood of the differences, averaged over what the numbers may be beforehand. A move that explains nothing, or what
//! another one explains as well, costs evidence. The search adds, removes and replaces moves as long as that is better.
//! How far places scatter is taken from the differences that all moves together leave.

use super::motion::{Motion, NUMBERS, USUAL};
use super::sightings::{Sighting, distance, place, sight};
use super::{Drift, Kind, NEAR_RAD};
use crate::data::Calibration;
use crate::estimate::median;
use crate::geometry::Device;
use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Point3, Vector3};
use rayon::prelude::*;

/// By how much a move must raise the logarithm of the evidence: it happens to one device in some hundred sessions.
const RARE: f64 = 5.0;

/// Neighbouring places have common errors: standard deviations are this many times those of independent places.
const ALIKE: f64 = 5.0;

/// Least scatter that the differences of two cameras are taken to have, rad.
const LEAST_SCALE_RAD: f64 = 0.01;

/// Steps with all moves, each with weights from the differences that the last one left.
const ROUNDS_OF_ALL: usize = 4;

/// Steps at most with the moves that were chosen.
const ROUNDS: usize = 6;

/// A step that changes no number by more ends the search, in units of [`USUAL`].
const SETTLED: f64 = 0.01;

/// Step by which numbers are changed to differentiate, in units of [`USUAL`].
const STEP: f64 = 0.05;

/// What moves as one: a camera, a projector or a head.
pub(super) struct Unit {
    pub name: String,
    /// Its devices by their places in [`Search::devices`].
    pub devices: Vec<usize>,
    /// The centre of its turns, world.
    pub centre: Point3<f64>,
}

/// One move that may have happened: numbers that are estimated together.
pub(super) struct Block {
    pub unit: usize,
    pub kind: Kind,
    /// The first of the unit's numbers that it has, and how many.
    pub numbers: std::ops::Range<usize>,
    /// Its first column in [`Search::effects`].
    pub column: usize,
}

pub(super) struct Search<'a> {
    pub calibration: &'a Calibration,
    /// All cameras of the calibration, then its projectors.
    pub devices: Vec<Device>,
    /// Of each camera, its projector's place among the devices.
    pub projector: Vec<usize>,
    /// The devices one by one, then the heads.
    pub units: Vec<Unit>,
    pub blocks: Vec<Block>,
    /// What may have happened: one move, or that all devices have turned. Blocks by their places.
    events: Vec<Vec<usize>>,
    /// How the numbers of all devices (rows) change with those of all blocks (columns).
    effects: DMatrix<f64>,
}

/// The sums of the normal equations, for the numbers of all blocks.
pub(super) struct Sums {
    normal: DMatrix<f64>,
    right: DVector<f64>,
}

impl Sums {
    /// The factor of the matrix for these columns, and the numbers that it gives.
    pub fn solve(&self, columns: &[usize]) -> Option<(Cholesky<f64, Dyn>, DVector<f64>)> {
        let n = columns.len();
        let prior = |i: usize, k: usize| if i == k { 1.0 } else { 0.0 };
        let matrix = DMatrix::from_fn(n, n, |i, k| self.normal[(columns[i], columns[k])] + prior(i, k));
        let right = DVector::from_fn(n, |i, _| self.right[columns[i]]);
        let factor = matrix.cholesky()?;
        let numbers = factor.solve(&right);
        Some((factor, numbers))
    }

    /// The logarithm of the evidence for these columns, without what all sets have in common.
    fn evidence(&self, columns: &[usize]) -> f64 {
        let Some((factor, numbers)) = self.solve(columns) else { return f64::NEG_INFINITY };
        let right = columns.iter().map(|&i| self.right[i]);
        let gained = right.zip(numbers.iter()).map(|(a, b)| a * b).sum::<f64>() / 2.0;
        gained - factor.l_dirty().diagonal().iter().map(|x| x.ln()).sum::<f64>()
    }
}

impl<'a> Search<'a> {
    pub fn new(calibration: &'a Calibration) -> Self {
        let cameras = calibration.cameras().count();
        let devices = calibration.cameras().map(|(_, camera)| &camera.device);
        let devices = devices.chain(calibration.heads.iter().map(|head| &head.projector));
        let devices: Vec<Device> = devices.cloned().collect();
        let heads = calibration.heads.iter().enumerate();
        let projector: Vec<usize> =
            heads.flat_map(|(h, head)| head.cameras.iter().map(move |_| cameras + h)).collect();
        let names = calibration.cameras().map(|(_, camera)| format!("camera {}", camera.id));
        let names = names.chain(calibration.heads.iter().map(|head| format!("projector {}", head.id)));
        let mut units: Vec<Unit> = names
            .enumerate()
            .map(|(i, name)| Unit { name, devices: vec![i], centre: devices[i].centre() })
            .collect();
        for (h, head) in calibration.heads.iter().enumerate() {
            let of = (0..cameras).filter(|&i| projector[i] == cameras + h).chain([cameras + h]);
            let of: Vec<usize> = of.collect();
            let sum: Vector3<f64> = of.iter().map(|&i| devices[i].centre().coords).sum();
            let centre = Point3::from(sum / of.len() as f64);
            units.push(Unit { name: format!("head {}", head.id), devices: of, centre });
        }
        let mut search = Self {
            calibration,
            devices,
            projector,
            units,
            blocks: Vec::new(),
            events: Vec::new(),
            effects: DMatrix::zeros(0, 0),
        };
        search.add_blocks();
        search
    }

    /// All moves that may have happened, and their effects.
    fn add_blocks(&mut self) {
        let single = [(Kind::Turn, 0..3), (Kind::Shift, 3..6), (Kind::FocalLength, 6..7)];
        let mut column = 0;
        for (unit, of) in self.units.iter().enumerate() {
            let kinds = if of.devices.len() > 1 { vec![(Kind::Whole, 0..6)] } else { single.to_vec() };
            for (kind, numbers) in kinds {
                let count = numbers.len();
                self.blocks.push(Block { unit, kind, numbers, column });
                column += count;
            }
        }
        let mut effects = DMatrix::zeros(NUMBERS * self.devices.len(), column);
        for block in &self.blocks {
            for (i, number) in block.numbers.clone().enumerate() {
                let mut column = effects.column_mut(block.column + i);
                if block.kind != Kind::Whole {
                    column[NUMBERS * self.units[block.unit].devices[0] + number] = 1.0;
                    continue;
                }
                let (turn, shift) = whole(number);
                for &device in &self.units[block.unit].devices {
                    let to_device = self.devices[device].world_from_device.isometry().rotation.inverse();
                    let lever = self.devices[device].centre() - self.units[block.unit].centre;
                    let (own_turn, own_shift) = (to_device * turn, to_device * (turn.cross(&lever) + shift));
                    for axis in 0..3 {
                        column[NUMBERS * device + axis] = own_turn[axis] / USUAL[axis];
                        column[NUMBERS * device + 3 + axis] = own_shift[axis] / USUAL[3 + axis];
                    }
                }
            }
        }
        self.effects = effects;
        self.events = (0..self.blocks.len()).map(|i| vec![i]).collect();
        self.events.push((0..self.blocks.len()).filter(|i| self.blocks[*i].kind == Kind::Turn).collect());
    }

    /// The devices that a sighting depends on: its camera and that one's projector, the other camera and that one's.
    pub(super) fn of(&self, s: &Sighting) -> [usize; 4] {
        [s.camera, self.projector[s.camera], s.other, self.projector[s.other]]
    }

    /// By how much the other camera differs, rad, where the devices stand so; `seen` is the line of sight, camera axes.
    fn difference(
        &self,
        s: &Sighting,
        seen: &Vector3<f64>,
        [camera, projector, other, its_projector]: [&Device; 4],
    ) -> Option<f64> {
        let column = self.calibration.pattern.column(s.phase);
        let distance_m = distance(camera, projector, seen, column, s.distance_m)?;
        let point = place(camera, seen, distance_m);
        let [u, v] = other.project(&point)?;
        let seen = s.other_phase + s.other_slope[0] * (u - s.at[0]) + s.other_slope[1] * (v - s.at[1]);
        let [column, _] = its_projector.project(&point)?;
        Some(seen - self.calibration.pattern.phase(column))
    }

    pub(super) fn differences(&self, sightings: &[Sighting], devices: &[Device]) -> Vec<Option<f64>> {
        let of = |s: &Sighting| {
            self.difference(s, &sight(&devices[s.camera], s.pixel)?, self.of(s).map(|i| &devices[i]))
        };
        sightings.par_iter().map(of).collect()
    }

    /// The scale of the differences after these motions, rad.
    fn scale_at(&self, sightings: &[Sighting], motions: &[Motion]) -> f64 {
        scale(self.differences(sightings, &self.moved(motions)).into_iter().flatten())
    }

    /// The devices after these motions, one each.
    fn moved(&self, motions: &[Motion]) -> Vec<Device> {
        self.devices.iter().zip(motions).map(|(device, motion)| motion.apply(device)).collect()
    }

    /// The difference at a place, and how it changes with the numbers of each of its devices (in units of [`USUAL`]).
    fn slopes(&self, s: &Sighting, now: &[Device], beside: &[[[Device; 2]; NUMBERS]]) -> Option<Row> {
        let of = self.of(s);
        let seen = sight(&now[s.camera], s.pixel)?;
        let mut distinct = of.to_vec();
        distinct.sort_unstable();
        // A projector that both have is one device.
        distinct.dedup();
        let mut slopes = Vec::with_capacity(4 * NUMBERS);
        for device in distinct {
            for (number, both) in beside[device].iter().enumerate() {
                let at = |way: usize| {
                    let stands = |i: usize| if i == device { &both[way] } else { &now[i] };
                    // Only another focal length changes what a pixel sees, in the camera's own axes.
                    let focal = number + 1 == NUMBERS && device == s.camera;
                    let seen = if focal { sight(&both[way], s.pixel)? } else { seen };
                    self.difference(s, &seen, of.map(stands))
                };
                slopes.push((NUMBERS * device + number, (at(0)? - at(1)?) / (2.0 * STEP)));
            }
        }
        Some((self.difference(s, &seen, of.map(|i| &now[i]))?, slopes))
    }

    /// The sums at these numbers of all devices, where differences have this scale, rad.
    fn sums(&self, sightings: &[Sighting], numbers: &DVector<f64>, scale: f64) -> Sums {
        let motion = |device: usize, change: Option<(usize, f64)>| {
            let mut own: [f64; NUMBERS] = std::array::from_fn(|i| numbers[NUMBERS * device + i]);
            if let Some((number, by)) = change {
                own[number] += by;
            }
            Motion::of(&own).apply(&self.devices[device])
        };
        let all = 0..self.devices.len();
        let now: Vec<Device> = all.clone().map(|device| motion(device, None)).collect();
        let beside: Vec<[[Device; 2]; NUMBERS]> = all
            .map(|device| std::array::from_fn(|i| [STEP, -STEP].map(|by| motion(device, Some((i, by))))))
            .collect();
        let rows: Vec<Option<Row>> = sightings.par_iter().map(|s| self.slopes(s, &now, &beside)).collect();
        let n = numbers.len();
        let (mut normal, mut right) = (DMatrix::zeros(n, n), DVector::zeros(n));
        for (difference, slopes) in rows.iter().flatten() {
            let robust = 1.0 / (1.0 + (difference / (2.0 * scale)).powi(2));
            let weight = robust / (ALIKE * scale).powi(2);
            // Counted from the calibration, not from where the devices are thought to stand.
            let from_calibration = difference - slopes.iter().map(|&(i, a)| a * numbers[i]).sum::<f64>();
            for &(i, a) in slopes {
                right[i] -= weight * a * from_calibration;
                for &(k, b) in slopes {
                    normal[(i, k)] += weight * a * b;
                }
            }
        }
        let to_blocks = self.effects.transpose();
        Sums { normal: &to_blocks * normal * &self.effects, right: to_blocks * right }
    }

    /// The columns of these blocks.
    pub(super) fn columns(&self, blocks: &[usize]) -> Vec<usize> {
        let columns =
            |&i: &usize| self.blocks[i].column..self.blocks[i].column + self.blocks[i].numbers.len();
        blocks.iter().flat_map(columns).collect()
    }

    /// The numbers of all blocks, of which only these are not 0.
    fn solve(&self, sums: &Sums, blocks: &[usize]) -> DVector<f64> {
        let mut found = DVector::zeros(self.effects.ncols());
        let columns = self.columns(blocks);
        if let Some((_, solved)) = sums.solve(&columns) {
            columns.iter().zip(solved.iter()).for_each(|(&i, x)| found[i] = *x);
        }
        found
    }

    /// The moves of these events, each once.
    fn moves_of(&self, events: &[usize]) -> Vec<usize> {
        let mut blocks: Vec<usize> = events.iter().flat_map(|&i| self.events[i].iter().copied()).collect();
        blocks.sort_unstable();
        blocks.dedup();
        blocks
    }

    /// The moves of the set of events that no single change makes better.
    fn choose(&self, sums: &Sums) -> Vec<usize> {
        let score =
            |set: &[usize]| sums.evidence(&self.columns(&self.moves_of(set))) - RARE * set.len() as f64;
        let (mut chosen, mut best) = (Vec::new(), 0.0);
        loop {
            let others = || (0..self.events.len()).filter(|i| !chosen.contains(i));
            let without = |i: usize| chosen.iter().copied().filter(move |&k| k != i);
            let more = others().map(|i| chosen.iter().copied().chain([i]).collect::<Vec<usize>>());
            let fewer = chosen.iter().map(|&i| without(i).collect());
            let replaced =
                chosen.iter().flat_map(|&i| others().map(move |k| without(i).chain([k]).collect()));
            // All of them for one.
            let instead = others().map(|i| vec![i]);
            let scored = more.chain(fewer).chain(replaced).chain(instead).map(|set| (score(&set), set));
            match scored.max_by(|a, b| a.0.total_cmp(&b.0)) {
                Some((better, set)) if better > best + 1e-6 => (best, chosen) = (better, set),
                _ => return self.moves_of(&chosen),
            }
        }
    }

    /// The moves that the places show which were not held back, judged by those that were. `start` is how the devices
    /// stood when the places were found.
    pub fn run(&self, sightings: &[Sighting], start: &[Motion]) -> Drift {
        let (held_back, fitted): (Vec<Sighting>, Vec<Sighting>) =
            sightings.iter().cloned().partition(|s| s.held_back);
        let started = self.scale_at(sightings, start);
        let mut numbers = DVector::zeros(NUMBERS * self.devices.len());
        for (own, motion) in numbers.as_mut_slice().chunks_mut(NUMBERS).zip(start) {
            own.copy_from_slice(&motion.numbers());
        }
        let known = numbers.clone();
        let all: Vec<usize> = (0..self.blocks.len()).collect();
        for _ in 0..ROUNDS_OF_ALL {
            let sums = self.sums(&fitted, &numbers, self.scale_at(&fitted, &motions_of(&numbers)));
            numbers = &self.effects * self.solve(&sums, &all);
        }
        let scale_rad = self.scale_at(&fitted, &motions_of(&numbers));
        let (mut sums, mut chosen, mut found);
        let mut round = 0;
        loop {
            sums = self.sums(&fitted, &numbers, scale_rad);
            // As long as many fringe orders are wrong there is little to choose by: mounts turn first of all.
            chosen = if started < NEAR_RAD {
                self.choose(&sums)
            } else {
                self.events.last().cloned().unwrap_or_default()
            };
            found = self.solve(&sums, &chosen);
            let next = &self.effects * &found;
            let step = (&next - &numbers).amax();
            numbers = next;
            round += 1;
            if step < SETTLED || round == ROUNDS {
                break;
            }
        }
        let motions = motions_of(&numbers);
        let both = [vec![Motion::default(); motions.len()], motions.clone()];
        let differ_rad = both.each_ref().map(|motions| self.scale_at(sightings, motions));
        Drift {
            devices: self.moves(sightings, &sums, &chosen, &found),
            sightings: sightings.len(),
            differ_rad,
            held_back: self.judge(&held_back, &both.map(|motions| self.moved(&motions))),
            motions,
            started_rad: started,
            changed: (&numbers - known).amax(),
        }
    }
}

/// A difference, and how it changes with numbers of devices: the number's place and the slope.
type Row = (f64, Vec<(usize, f64)>);

/// The motion of each device.
fn motions_of(numbers: &DVector<f64>) -> Vec<Motion> {
    numbers.as_slice().chunks(NUMBERS).map(Motion::of).collect()
}

/// The turn (rad) and the shift (m) of a head that one of its numbers is, world axes; none for the last, which it has not.
pub(super) fn whole(number: usize) -> (Vector3<f64>, Vector3<f64>) {
    let motion = Motion::unit(number);
    (motion.turn, motion.shift_m)
}

/// 1.4826 times the median of the sizes, rad.
pub(super) fn scale(differences: impl Iterator<Item = f64>) -> f64 {
    // Without any differences this is the least: `max` leaves out NaN.
    (1.4826 * median(differences.map(f64::abs))).max(LEAST_SCALE_RAD)
}
