// SPDX-License-Identifier: MIT OR Apache-2.0
//! The fringe orders in a view of the board, found from the board itself.
//!
//! A frame by itself has its fringe orders from its marker, and a marker may be misread: then the whole view is some
//! fringes off. But the circles give the board's pose, and the projector's model gives the panel column that lights
//! each point of it. The projector that most markers agree on is sought first ([`agree`]); its column at a point gives
//! the order there. A view needs no marker of its own, and no offset of whole fringes can be left in one.
//!
//! An offset of whole fringes is never motion: the board would have moved by some 40 mm along the view for each, and
//! its circles would not be where the white frame has them.

use super::bundle::{DeviceModel, Model, SeenColumn, column_error, fit_columns};
use super::estimate::median;
use super::findings::{Finding, Kind};
use super::phases::{LEAST_PHASE_POINTS, LEAST_PHASES, Reading, Which};
use super::rigging::{Excluded, HeadResult, Misread, Rigging, StageError};
use std::collections::BTreeSet;

/// Fewest views whose markers must agree.
const LEAST_AGREEING: usize = 4;
/// Most points of a view by which it is judged, evenly spread.
const POINTS: usize = 40;
/// A view agrees with a projector that explains its columns to this share of a fringe.
const AGREES: f64 = 0.25;
/// The next view is taken in when it is explained to this share: its whole fringes are certain.
const NEXT: f64 = 0.45;

impl Rigging<'_> {
    /// Brings the projector, the last of the model's devices, to where most markers have it: to a fraction of a fringe.
    pub(super) fn settle_orders(
        &self,
        head: usize,
        positions: &[usize],
        model: &mut Model,
        excluded: &Excluded,
    ) -> Result<(), StageError> {
        let projector = model.devices.len() - 1;
        let (mut marked, mut places) = (Vec::new(), BTreeSet::new());
        for which in self.views_with_phase(head, positions, excluded) {
            let readings = self.readings(head, which, model);
            if readings.len() < LEAST_PHASE_POINTS {
                continue;
            }
            places.insert(which.position);
            let read = self.by_marker(head, which, readings);
            if read.len() >= LEAST_PHASE_POINTS {
                let pose = model.boards[which.board];
                let seen = |r: &Reading| (pose * r.point, r.column);
                marked.push(spread(&read).map(seen).collect::<Vec<SeenColumn>>());
            }
        }
        if places.len() < LEAST_PHASES {
            // Too little for any projector; `check_phases` reports it.
            return Ok(());
        }
        let (found, agreeing) = agree(&marked, &model.devices[projector], self.nominal.pattern.period_px);
        if agreeing < LEAST_AGREEING || 2 * agreeing <= marked.len() {
            return Err(StageError::Refused(format!(
                "head {}: the markers in {agreeing} of {} frames with fringes agree on the fringe orders, expected at least {LEAST_AGREEING} and more than half of them. Project the rig's pattern (`fourdbody pattern`), sharp, and show the board where the marker falls on it",
                self.head_name(head),
                marked.len()
            )));
        }
        model.devices[projector] = found;
        Ok(())
    }

    /// The readings whose fringe orders the view's own marker gives.
    fn by_marker(&self, head: usize, which: Which, readings: Vec<Reading>) -> Vec<Reading> {
        let phase = self.view(head, which.camera, which.position).and_then(|view| view.phase.as_ref());
        let marker = phase.is_some_and(|phase| phase.marker);
        readings.into_iter().filter(|reading| marker && reading.by_marker).collect()
    }

    /// The views whose own markers give other orders than the board.
    pub(super) fn misread(&self, result: &HeadResult, excluded: &Excluded) -> Vec<Misread> {
        let period = self.nominal.pattern.period_px;
        let views = self.views_with_phase(result.head, &result.positions, excluded).into_iter();
        let of_view = |which: Which| {
            let readings = self.readings(result.head, which, &result.all.model);
            let read = self.by_marker(result.head, which, readings);
            // Without readings the median is NaN, which becomes 0 fringes.
            let fringes = (median(read.iter().map(Reading::excess)) / period).round() as i64;
            (fringes != 0).then_some(Misread { camera: which.camera, position: which.position, fringes })
        };
        views.filter_map(of_view).collect()
    }

    pub(super) fn misread_finding(&self, head: usize, misread: &Misread) -> Finding {
        let position = &self.positions[misread.position];
        let camera = &self.nominal.heads[head].cameras[misread.camera].id;
        let trigger = position.fringes.unwrap_or(position.white);
        let message = format!(
            "its marker was read {} fringes from where the board has it; the fringe orders are those that the board gives",
            misread.fringes
        );
        Finding::left_out(camera, trigger, Some(misread.position), Kind::MarkerMisread, message).used()
    }
}

/// Some of the readings, spread over all.
fn spread(readings: &[Reading]) -> impl Iterator<Item = &Reading> {
    readings.iter().step_by(readings.len().div_ceil(POINTS).max(1))
}

/// The projector near `start` that explains the columns of most views, and how many: grown from each view in turn,
/// until most are in.
fn agree(views: &[Vec<SeenColumn>], start: &DeviceModel, period: f64) -> (DeviceModel, usize) {
    let mut best = (*start, 0);
    for seed in 0..views.len() {
        let grown = grow(views, seed, start, period);
        if grown.1 > best.1 {
            best = grown;
        }
        if 2 * best.1 > views.len() {
            break;
        }
    }
    best
}

/// Fits the projector to one view, then to those that it explains, and so on: each view adds what the others leave
/// open.
fn grow(views: &[Vec<SeenColumn>], seed: usize, start: &DeviceModel, period: f64) -> (DeviceModel, usize) {
    let mut members = vec![seed];
    // Each round takes in one view at least, or is the last.
    for _ in 0..views.len() {
        let seen: Vec<SeenColumn> = members.iter().flat_map(|&view| views[view].iter().copied()).collect();
        let device = fit_columns(start, &seen);
        let off: Vec<f64> = views
            .iter()
            .map(|view| median(view.iter().map(|seen| column_error(&device, seen))).abs() / period)
            .collect();
        let mut next: Vec<usize> = (0..views.len()).filter(|&view| off[view] < AGREES).collect();
        if next.len() <= members.len() {
            let others = (0..views.len()).filter(|view| !next.contains(view) && off[*view] < NEXT);
            match others.min_by(|a, b| off[*a].total_cmp(&off[*b])) {
                Some(other) if !members.contains(&other) => next.push(other),
                _ => return (device, next.len()),
            }
        }
        members = next;
    }
    let seen: Vec<SeenColumn> = members.iter().flat_map(|&view| views[view].iter().copied()).collect();
    (fit_columns(start, &seen), members.len())
}

#[cfg(test)]
mod tests {
    use super::super::bundle::{DeviceModel, SeenColumn, column_error};
    use super::agree;
    use crate::geometry::Lens;
    use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};

    const PERIOD: f64 = 8.0;

    /// A projector, and the same as a rig file has it: a per cent, a centimetre and half a degree off.
    fn projector(is_true: bool) -> DeviceModel {
        let off = f64::from(u8::from(!is_true));
        let lens = Lens {
            fx: 1400.0 * (1.0 - 0.01 * off),
            fy: 1400.0,
            cx: 639.5 + 12.0 * off,
            cy: 399.5,
            distortion: [-0.06 * (1.0 - off), 0.0, 0.0, 0.0, 0.0],
        };
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.008, -0.009, 0.006) * off);
        let shift = Vector3::new(0.01, -0.01, 2.4 + 0.012 * off);
        DeviceModel { lens, device_from_frame: Isometry3::from_parts(shift.into(), turn) }
    }

    /// What cameras see of a board at ten places, each some fringes off.
    fn views(fringes: impl Fn(usize) -> f64, moved: impl Fn(usize) -> f64) -> Vec<Vec<SeenColumn>> {
        let truth = projector(true);
        let view = |i: usize| {
            let tilt = Vector3::new(0.3 * ((i % 5) as f64 - 2.0) / 2.0, 0.35 * ((i % 3) as f64 - 1.0), 0.1);
            let shift = Vector3::new(0.0, 0.05, 0.08 * i as f64 - 0.4);
            let pose = Isometry3::from_parts(shift.into(), UnitQuaternion::from_scaled_axis(tilt));
            let points = (0..40).map(|k| {
                let (x, y) = (f64::from(k % 8) * 0.12 - 0.42, f64::from(k / 8) * 0.14 - 0.28);
                pose * Point3::new(x, y, 0.0)
            });
            let seen = |p: Point3<f64>| (p, column_error(&truth, &(p, 0.0)) + PERIOD * fringes(i) + moved(i));
            points.map(seen).collect()
        };
        (0..10).map(view).collect()
    }

    /// How far from the true columns a projector is, at worst, px.
    fn off(found: &DeviceModel) -> f64 {
        let seen = views(|_| 0.0, |_| 0.0);
        seen.iter().flatten().map(|s| column_error(found, s).abs()).fold(0.0, f64::max)
    }

    #[test]
    fn the_rig_file_is_whole_fringes_off() {
        let worst = off(&projector(false));
        assert!(worst > 2.0 * PERIOD, "{worst} px: nothing to find out");
    }

    /// Every number of fringes, in one view, then in four of ten that differ in it.
    #[test]
    fn markers_that_are_misread_by_any_number_of_fringes_are_outvoted() {
        for k in (-160..=160).filter(|k| *k != 0) {
            let k = f64::from(k);
            for wrong in [1, 4] {
                let fringes = |i: usize| if i < wrong { k * (1.0 + i as f64) } else { 0.0 };
                let (found, agreeing) = agree(&views(fringes, |_| 0.0), &projector(false), PERIOD);
                assert_eq!(agreeing, 10 - wrong, "{k} fringes");
                assert!(off(&found) < 0.2 * PERIOD, "{k} fringes: {} px", off(&found));
            }
        }
    }

    #[test]
    fn a_board_that_moved_by_less_than_a_fringe_leaves_the_others_agreeing() {
        let moved = |i: usize| if i == 3 { 3.3 } else { 0.0 };
        let (found, agreeing) = agree(&views(|_| 0.0, moved), &projector(false), PERIOD);
        assert!(agreeing == 9 && off(&found) < 0.2 * PERIOD, "{agreeing}, {} px", off(&found));
    }

    #[test]
    fn markers_that_all_say_something_else_agree_on_nothing() {
        let scattered = |i: usize| [0.0, 31.0, -17.0, 64.0, -52.0, 9.0, 90.0, -71.0, 40.0, -33.0][i];
        let (_, agreeing) = agree(&views(scattered, |_| 0.0), &projector(false), PERIOD);
        assert!(agreeing < super::LEAST_AGREEING, "{agreeing}");
        assert_eq!(agree(&[], &projector(false), PERIOD).1, 0);
    }
}
