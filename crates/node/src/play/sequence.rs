// SPDX-License-Identifier: MIT OR Apache-2.0
//! The frame sets of a result in the order of triggers, and those of which nothing can be shown, with the reason.

use super::packed::packed;
use crate::batch::collect_shards::load_summary;
use crate::batch::result::{Clouds, Place};
use crate::batch::summary::{FrameSummary, Summary};
use crate::preview::quick_look::{POINT_BYTES, POINTS_MAX};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Holes that are listed; those beyond are left out.
const HOLES_MAX: usize = 1000;
/// Longest reason that is passed on, characters.
const WHY_MAX: usize = 300;

/// Triggers one after the other without a cloud, for the same reason.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Hole {
    /// The first trigger of the run.
    pub first: u64,
    /// The last trigger of the run.
    pub last: u64,
    /// Why there is no cloud.
    pub why: String,
}

/// What a player must know before it asks for a frame set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Described {
    /// Triggers a second, by the result's own times where it has some.
    pub trigger_rate_hz: f64,
    /// Points that a frame set has at most.
    pub points_each: usize,
    /// Triggers that have a cloud, as runs: first and last.
    pub runs: Vec<[u64; 2]>,
    /// Triggers that were to have one and have none.
    pub holes: Vec<Hole>,
    /// When each trigger of runs and holes was, in the order of triggers, seconds since trigger 0: by the result's own
    /// times, or by index at the rate where it has none.
    pub seconds: Vec<f64>,
}

impl Described {
    /// Whether a trigger has a cloud.
    pub fn has(&self, trigger: u64) -> bool {
        let after = self.runs.partition_point(|[first, _]| *first <= trigger);
        after.checked_sub(1).and_then(|run| self.runs.get(run)).is_some_and(|[_, last]| trigger <= *last)
    }
}

/// What of a result can be played.
pub struct Sequence {
    clouds: Clouds,
    sets: BTreeMap<u64, Place>,
    holes: Vec<Hole>,
}

impl Sequence {
    /// Lists the merged clouds, or the phase maps, of `result`, the directory of `fourdbody reconstruct`.
    ///
    /// # Errors
    /// There are none, or what is there cannot be read.
    pub fn open(result: &Path) -> Result<Self, String> {
        let summary = load_summary(result)?;
        let clouds = Clouds::open(result)?;
        let mut empty = without_points(&summary);
        for trigger in summary.triggers.iter().map(|one| one.trigger) {
            if let Some(missing) = clouds.missing_at(trigger) {
                empty.insert(trigger, format!("missing: {missing}"));
            }
        }
        let sets: BTreeMap<u64, Place> = clouds
            .merged
            .iter()
            .filter(|(trigger, _)| !empty.contains_key(trigger))
            .map(|(trigger, place)| (*trigger, place.clone()))
            .collect();
        if sets.is_empty() {
            return Err(format!(
                "{}: expected merged clouds or phase maps, found none: reconstruct the session first",
                result.display()
            ));
        }
        Ok(Self { clouds, sets, holes: runs_of_holes(empty) })
    }

    /// The triggers that have a cloud, ascending.
    pub fn triggers(&self) -> impl ExactSizeIterator<Item = u64> + '_ {
        self.sets.keys().copied()
    }

    /// Number of points of each frame set, so that all together have at most `most_bytes` before they are packed.
    pub fn points_each(&self, most_bytes: u64) -> usize {
        let share = most_bytes / self.sets.len().max(1) as u64 / POINT_BYTES as u64;
        usize::try_from(share).unwrap_or(usize::MAX).clamp(1, POINTS_MAX)
    }

    /// A frame set of at most `points_each` points; `None` where this trigger has no cloud.
    ///
    /// # Errors
    /// Its files cannot be read; which, and why.
    pub fn packed(&self, trigger: u64, points_each: usize) -> Option<Result<Vec<u8>, String>> {
        let place = self.sets.get(&trigger)?;
        Some(self.clouds.load(place).and_then(|(_, cloud)| packed(&cloud, points_each)))
    }

    /// For a player. `rate_hz` is that of results that state no times.
    pub fn described(&self, rate_hz: f64, points_each: usize) -> Described {
        let mut runs: Vec<[u64; 2]> = Vec::new();
        for trigger in self.triggers() {
            match runs.last_mut() {
                Some([_, last]) if last.checked_add(1) == Some(trigger) => *last = trigger,
                _ => runs.push([trigger, trigger]),
            }
        }
        let holes = self.holes.iter().flat_map(|hole| hole.first..=hole.last);
        let mut all: Vec<u64> = self.triggers().chain(holes).collect();
        all.sort_unstable();
        let known = |trigger: &u64| Some((*trigger, self.clouds.expected.time_ns(*trigger)?));
        let known: BTreeMap<u64, u64> = all.iter().filter_map(known).collect();
        let (trigger_rate_hz, seconds) = placed(&all, &known, rate_hz);
        Described { trigger_rate_hz, points_each, runs, holes: self.holes.clone(), seconds }
    }
}

/// Triggers per second, and when each trigger was, seconds since trigger 0: by the times that are known, ns, else by
/// index at `rate_hz`.
fn placed(triggers: &[u64], known_ns: &BTreeMap<u64, u64>, rate_hz: f64) -> (f64, Vec<f64>) {
    let ends = known_ns.first_key_value().zip(known_ns.last_key_value());
    let measured = ends.and_then(|((first, from), (last, to))| {
        let ns = to.checked_sub(*from).filter(|ns| *ns > 0)?;
        Some((last - first) as f64 * 1e9 / ns as f64)
    });
    let rate_hz = measured.unwrap_or(rate_hz);
    let since = |trigger: &u64| {
        let ((first, from), _) = ends?;
        let ns = i128::from(*known_ns.get(trigger)?) - i128::from(*from);
        Some(*first as f64 / rate_hz + ns as f64 / 1e9)
    };
    let seconds = triggers.iter().map(|trigger| since(trigger).unwrap_or(*trigger as f64 / rate_hz));
    (rate_hz, seconds.collect())
}

/// Triggers of which no camera gave a point, with the reason.
fn without_points(summary: &Summary) -> BTreeMap<u64, String> {
    let empty =
        summary.triggers.iter().filter(|trigger| trigger.frames.iter().all(|frame| frame.points == 0));
    empty.map(|trigger| (trigger.trigger, why(&trigger.frames))).collect()
}

/// The reason that most of the frames have.
fn why(frames: &[FrameSummary]) -> String {
    let mut counts = BTreeMap::<String, usize>::new();
    for FrameSummary { outcome, reason, .. } in frames {
        let said =
            reason.as_ref().map_or_else(|| outcome.to_string(), |reason| format!("{outcome}: {reason}"));
        *counts.entry(said).or_default() += 1;
    }
    let most = counts.into_iter().max_by_key(|(_, count)| *count).map(|(said, _)| said);
    most.unwrap_or_else(|| "no frames".to_owned()).chars().take(WHY_MAX).collect()
}

fn runs_of_holes(empty: BTreeMap<u64, String>) -> Vec<Hole> {
    let mut holes: Vec<Hole> = Vec::new();
    for (trigger, why) in empty {
        let follows = |hole: &Hole| hole.last.checked_add(1) == Some(trigger) && hole.why == why;
        let room = holes.len() < HOLES_MAX;
        match holes.last_mut() {
            Some(hole) if follows(hole) => hole.last = trigger,
            _ if !room => break,
            _ => holes.push(Hole { first: trigger, last: trigger, why }),
        }
    }
    holes
}

#[cfg(test)]
mod tests {
    use super::{Described, Hole, runs_of_holes, why};
    use crate::batch::summary::FrameSummary;

    #[test]
    fn holes_of_one_reason_are_one() {
        let empty = [(3, "refused"), (4, "refused"), (5, "gap"), (7, "gap")];
        let holes = runs_of_holes(empty.map(|(trigger, why)| (trigger, why.to_owned())).into());
        let hole = |first, last, why: &str| Hole { first, last, why: why.to_owned() };
        assert_eq!(holes, [hole(3, 4, "refused"), hole(5, 5, "gap"), hole(7, 7, "gap")]);
    }

    #[test]
    fn a_trigger_is_in_a_run_or_in_none() {
        let runs = vec![[0, 0], [3, 5], [u64::MAX, u64::MAX]];
        let (holes, seconds) = (Vec::new(), Vec::new());
        let described = Described { trigger_rate_hz: 120.0, points_each: 1, runs, holes, seconds };
        let found: Vec<u64> = (0..9).filter(|trigger| described.has(*trigger)).collect();
        assert_eq!(found, [0, 3, 4, 5]);
        assert!(described.has(u64::MAX) && !described.has(u64::MAX - 1));
    }

    #[test]
    fn triggers_are_placed_by_their_own_times() {
        // 20 Hz by a clock that is 20 ppm fast, one trigger 300 us late.
        let ns = |trigger: u64| {
            1_790_000_000_000_000_000 + trigger * 49_999_000 + if trigger == 5 { 300_000 } else { 0 }
        };
        let known = (2..=9).map(|trigger| (trigger, ns(trigger))).collect();
        let (rate_hz, seconds) = super::placed(&[2, 3, 5, 9], &known, 120.0);
        assert!((rate_hz - 1e9 / 49_999_000.0).abs() < 1e-9, "{rate_hz}");
        for (found, trigger) in seconds.iter().zip([2, 3, 5, 9]) {
            let expected = (ns(trigger) - ns(0)) as f64 / 1e9;
            assert!((found - expected).abs() < 1e-9, "{trigger}: {found} {expected}");
        }
        let (rate_hz, seconds) = super::placed(&[0, 60], &std::collections::BTreeMap::new(), 120.0);
        assert_eq!((rate_hz, seconds), (120.0, vec![0.0, 0.5]));
    }

    #[test]
    fn a_hole_has_the_reason_of_most_frames() {
        let frame =
            |outcome, reason: &str| FrameSummary::missing(&"h0_up".into(), outcome, reason.to_owned());
        let frames = [frame("gap", "late"), frame("refused", "moved"), frame("refused", "moved")];
        assert_eq!(why(&frames), "refused: moved");
        assert_eq!(why(&[]), "no frames");
    }
}
