// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether an adjusted head is consistent: all positions agree, residuals are small, and sizes are those of the rig
//! file.

use super::estimate::median;
use super::findings::{Finding, Kind};
use super::observed::Position;
use super::rigging::{Excluded, HeadResult, Rigging, StageError};
use std::collections::BTreeSet;

/// A view contradicts the others when its median residual is this many times the median of all views.
const TIMES: f64 = 4.0;
/// Median residual of circles below which a view never contradicts the others, image px.
const CIRCLES_PX: f64 = 0.1;
/// Median residual of phases below which a view never contradicts the others, panel px.
const PHASES_PX: f64 = 0.1;

impl Excluded {
    /// Leaves out the views that contradict the others most, and reports them. Circles go first: phases depend on them.
    pub(super) fn contradicting(&mut self, rigging: &Rigging<'_>, result: &HeadResult) -> Vec<Finding> {
        let circles = worst(&medians(result, true), CIRCLES_PX);
        let (bad, moved) = if circles.is_empty() {
            (worst(&medians(result, false), PHASES_PX), true)
        } else {
            (circles, false)
        };
        let excluded = if moved { &mut self.phases } else { &mut self.views };
        excluded.extend(bad.iter().map(|(key, _)| *key));
        let finding = |((camera, place), px): (Key, f64)| {
            let camera = &rigging.nominal.heads[result.head].cameras[camera].id;
            let position = &rigging.positions[place];
            if moved {
                let message = format!(
                    "the phase contradicts the circles by {px:.2} panel px beside whole fringes: the board moved between the white frame and the fringes. Hold it still"
                );
                let trigger = position.fringes.unwrap_or(position.white);
                return Finding::left_out(camera, trigger, Some(place), Kind::Moved, message);
            }
            let message = format!(
                "its circles contradict the other positions by {px:.2} px: did the board move or bend, or is it another board?"
            );
            Finding::left_out(camera, position.white, Some(place), Kind::Disagrees, message)
        };
        bad.into_iter().map(finding).collect()
    }

    /// Refuses a head of which more than half of the views are left out.
    pub(super) fn check(&self, rigging: &Rigging<'_>, head: usize) -> Result<(), StageError> {
        let cameras = rigging.nominal.cameras_of(head);
        let views = |p: &Position| p.views[cameras.clone()].iter().flatten().count();
        let views: usize = rigging.positions.iter().map(views).sum();
        let excluded = self.views.union(&self.phases).count();
        if 2 * excluded > views {
            return Err(StageError::Refused(format!(
                "head {}: {excluded} of {views} views contradict the others; nothing can be trusted. Is the board stiff, does its file give the measured centres, did it stand still from the white frame to the fringes?",
                rigging.head_name(head)
            )));
        }
        Ok(())
    }
}

type Key = (usize, usize);

/// Median residual by camera and position: of circles, px along both axes, or of phases, panel px.
fn medians(result: &HeadResult, circles: bool) -> Vec<(Key, f64)> {
    let mut keys: BTreeSet<Key> = BTreeSet::new();
    let key_of = |i: usize| {
        let o = &result.observations[i];
        let camera = i.checked_sub(result.circles).map_or(o.device, |phase| result.phase_cameras[phase]);
        (camera, result.positions[o.board])
    };
    let range = if circles { 0..result.circles } else { result.circles..result.observations.len() };
    range.clone().for_each(|i| {
        keys.insert(key_of(i));
    });
    let size = |i: usize| {
        let [u, v] = result.all.residuals[i];
        if circles { u.hypot(v) } else { u.abs() }
    };
    let of = |key: Key| median(range.clone().filter(|i| key_of(*i) == key).map(size));
    keys.into_iter().map(|key| (key, of(key))).collect()
}

/// Those far beyond the rest: at least half as bad as the worst, since one bad view also pulls at good ones.
fn worst(medians: &[(Key, f64)], least_px: f64) -> Vec<(Key, f64)> {
    let usual = median(medians.iter().map(|(_, px)| *px));
    let most = medians.iter().map(|(_, px)| *px).fold(0.0, f64::max);
    let limit = (TIMES * usual).max(least_px).max(most / 2.0);
    medians.iter().filter(|(_, px)| *px > limit).copied().collect()
}

/// Largest median residual of circles (image px) and of phases (panel px) in a head that is accepted.
const RESIDUAL_PX: f64 = 0.25;
/// Largest difference of the distance between a head's cameras from the rig file's, as a share.
const SCALE: f64 = 0.05;
/// Largest standard deviation of a focal length, as a share of it.
const FOCAL: f64 = 0.003;

impl Rigging<'_> {
    /// Refuses what would be a bad calibration.
    pub(super) fn check(&self, result: &HeadResult) -> Result<(), StageError> {
        let refused =
            |why: String| Err(StageError::Refused(format!("head {}: {why}", self.head_name(result.head))));
        for (what, circles) in [("circles", true), ("phases", false)] {
            let found = median(medians(result, circles).into_iter().map(|(_, px)| px));
            if !(found <= RESIDUAL_PX) {
                return refused(format!(
                    "{what} are explained to {} thousandths of a pixel, expected {} or less. Is the board flat, and its file that of this board?",
                    (found * 1e3) as u32,
                    RESIDUAL_PX * 1e3
                ));
            }
        }
        let devices = &result.all.model.devices;
        let nominal = &self.nominal.heads[result.head];
        if let [first, .., last] = nominal.cameras.as_slice() {
            let expected = (first.device.centre() - last.device.centre()).norm();
            let centre = |d: usize| devices[d].device_from_frame.inverse().translation.vector;
            let found = (centre(0) - centre(nominal.cameras.len() - 1)).norm();
            if expected > 0.1 && (found / expected - 1.0).abs() > SCALE {
                return refused(format!(
                    "its cameras come out {:.0} % as far apart as in the rig file, expected 95 to 105. Is it the file of this board, in metres?",
                    (100.0 * found / expected).round()
                ));
            }
        }
        for (d, (device, sigma)) in devices.iter().zip(&result.all.device_sigma).enumerate() {
            let share = sigma[0] / device.lens.fx;
            if !(share <= FOCAL) {
                let name = nominal.cameras.get(d).map_or("the projector", |camera| camera.id.as_str());
                return refused(format!(
                    "the focal length of {name} is known to {:.0} per mille only, expected 3 or less. More positions are needed that fill the image and are tilted more",
                    (share * 1e3).round()
                ));
            }
        }
        Ok(())
    }
}
