// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which triggers the frames of the warm-up are of, found again from the raw samples.
//!
//! Before some triggers of the warm-up the HSU pauses for longer (`hsu-protocol.md`). So only at the right place is the
//! way from trigger to frame the same for all of them. How long that way is, is not assumed, nor that ids count every
//! trigger.

use super::frame::{Frame, Seen, skipped};
use super::table::Table;
use crate::matcher::anchor::STALL_NS;

/// Frames of the warm-up that are considered, from the first of the stream on.
const FRAMES: usize = 64;
/// Triggers that are considered, from the first of the warm-up on.
const TRIGGERS: usize = 256;
/// Frames that must fit a place, at least; three quarters of all must.
const ENOUGH: usize = 5;
/// Frames by which the best place must lead the second best.
const MARGIN: usize = 2;
/// The same by arrivals alone, where all frames but one must fit, three quarters of them as their ids count: a busy
/// host has rhythms of its own.
const MARGIN_OF_ARRIVALS: usize = 3;
/// Frames from the first one on that places are tried with: the first may be of no trigger.
const TRIED: usize = 3;
/// Periods after its trigger within which a frame arrives, where the host does not stand still.
const LATEST_PERIODS: i128 = 8;

/// A place that was tried.
struct Fit {
    /// From a trigger to what is seen of its frame, ns.
    way_ns: i128,
    /// Frames with the triggers that they fit, as their ids count them.
    frames: Vec<Frame>,
    fitting: usize,
}

/// The frames of a camera's warm-up at their triggers; empty where the rhythm is not found. By arrivals alone it may be
/// found in the first of them, as a node finds it while they arrive, even if the host stands still later.
pub fn warm_up(seen: &[Seen], table: &Table) -> Vec<Frame> {
    let seen = &seen[..seen.len().min(FRAMES)];
    let stamped = seen.iter().filter(|seen| seen.camera_ns != 0).count() * 2 > seen.len();
    let least = if stamped { seen.len() } else { ENOUGH };
    let triggers = table.begin(TRIGGERS);
    let mut first =
        (least..=seen.len()).rev().map(|count| found_in(&seen[..count], stamped, &triggers, table));
    first.find(|frames| !frames.is_empty()).unwrap_or_default()
}

/// The triggers of these frames, if their rhythm is found in all of them.
fn found_in(seen: &[Seen], stamped: bool, triggers: &[(i64, i128)], table: &Table) -> Vec<Frame> {
    // By the camera's own clock, or by arrivals, in the HSU's time but for a constant.
    let at = |seen: &Seen| match stamped {
        true => Some(i128::from(seen.camera_ns)).filter(|ns| *ns != 0),
        false => Some(i128::from(seen.host_ns)),
    };
    let mut fits: Vec<Fit> = Vec::new();
    for first in seen.iter().filter_map(at).take(TRIED) {
        for (_, hsu_ns) in triggers {
            let way_ns = first - hsu_ns;
            if fits.iter().all(|fit| (fit.way_ns - way_ns).abs() > table.period_ns / 4) {
                let all = fitting(seen, triggers, &at, way_ns, table.period_ns);
                // A frame that arrives late may fit a later trigger than its own: the count of ids decides.
                let frames = if stamped { all.clone() } else { counted_alike(&all) };
                fits.push(Fit { way_ns, frames, fitting: all.len() });
            }
        }
    }
    fits.retain(|fit| is_possible(&fit.frames, table));
    fits.sort_by_key(|fit| std::cmp::Reverse(fit.fitting));
    let second = fits.get(1).map_or(0, |fit| fit.fitting);
    let best = fits.into_iter().next().filter(|best| {
        let (count, fitting) = (best.frames.len(), best.fitting);
        let clear = match stamped {
            true => fitting * 4 >= seen.len() * 3 && fitting >= second + MARGIN,
            // As the node finds it: a frame held up with the next fits the next one's trigger, and leaves that none.
            false => {
                count * 4 >= fitting * 3
                    && fitting + 1 >= seen.len()
                    && fitting >= second + MARGIN_OF_ARRIVALS
            }
        };
        clear && count >= ENOUGH
    });
    best.map(|best| best.frames).unwrap_or_default()
}

/// Most of the frames whose ids go on as their triggers do.
fn counted_alike(frames: &[Frame]) -> Vec<Frame> {
    let alike = |first: &Frame| frames.iter().filter(|frame| skipped(first, frame) == 0).copied().collect();
    frames.iter().map(alike).max_by_key(Vec::len).unwrap_or_default()
}

/// The frames that lie at triggers, each at one of its own.
fn fitting(
    seen: &[Seen],
    triggers: &[(i64, i128)],
    at: &impl Fn(&Seen) -> Option<i128>,
    way_ns: i128,
    period_ns: i128,
) -> Vec<Frame> {
    let mut frames: Vec<Frame> = Vec::new();
    for seen in seen {
        let Some(due) = at(seen).map(|ns| ns - way_ns) else { continue };
        let after = triggers.partition_point(|(_, hsu_ns)| *hsu_ns < due);
        let near = triggers[after.saturating_sub(1)..(after + 1).min(triggers.len())].iter();
        let nearest = near.min_by_key(|(_, hsu_ns)| (hsu_ns - due).abs());
        let Some((number, hsu_ns)) = nearest.copied() else { continue };
        let is_next = frames.last().is_none_or(|last| last.number < number);
        // A third of what the rhythm's pauses add.
        if is_next && number < 0 && (hsu_ns - due).abs() <= period_ns / 6 {
            frames.push(Frame { number, hsu_ns, seen: *seen });
        }
    }
    frames
}

/// Nothing arrives before its trigger, nor long behind it.
fn is_possible(frames: &[Frame], table: &Table) -> bool {
    let late = |frame: &Frame| {
        let fired = table.host_time(frame.hsu_ns, frame.number)?;
        Some((i128::from(frame.seen.host_ns) - fired.ns, fired.open_ns))
    };
    let slack = table.period_ns / 8;
    let mut ways: Vec<i128> = Vec::new();
    for (way, open) in frames.iter().filter_map(late) {
        if way + open + slack < 0 {
            return false;
        }
        ways.push(way);
    }
    let latest = (LATEST_PERIODS * table.period_ns).max(i128::from(STALL_NS));
    ways.iter().min().is_none_or(|quickest| *quickest <= latest)
}
