// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the frames of a few pulses show of a camera: the head that it is wired to, and the delays of its timestamps and
//! packets. Pure functions.

/// Time from one head's pulse to the next head's, ns: longer than any camera's delay.
pub const STEP_NS: u64 = 200_000_000;
/// Time from the trigger to the first head's pulse, ns.
const FIRST_NS: u64 = 1_000_000;

/// Time from the trigger to a head's pulse, ns.
pub fn head_delay_ns(head: usize) -> u64 {
    FIRST_NS + STEP_NS * head as u64
}

/// The period of such a train, ns.
pub fn period_ns(heads: usize) -> u64 {
    head_delay_ns(heads) + STEP_NS / 2
}

/// One frame's times on the host's clock, ns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameTimes {
    /// Arrival of its first packet.
    pub arrived_ns: u64,
    /// Its timestamp; `None` where the camera has none that can be related to the host's clock.
    pub stamped_ns: Option<u64>,
}

/// What pulses show of a camera's wiring and delays.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Delays {
    /// The number of the head whose pulse it answers.
    pub head: usize,
    /// From the edge to the stamp, us.
    pub stamp_us: Option<f64>,
    /// From the edge to the first packet, us.
    pub arrival_us: f64,
}

fn median(mut values: Vec<i64>) -> Option<i64> {
    values.sort_unstable();
    values.get(values.len() / 2).copied()
}

/// Reads the frames that a camera sent after these triggers (host clock, ns, ascending). `None` unless it sent one for
/// each of them; the first may be missing, as cameras lose one after a pause.
pub fn read(triggers: &[u64], frames: &[FrameTimes], heads: usize) -> Option<Delays> {
    let period = period_ns(heads);
    let late = |frame: &FrameTimes| {
        let trigger = triggers.iter().rev().find(|trigger| **trigger <= frame.arrived_ns)?;
        (frame.arrived_ns - trigger < period).then_some((*trigger, frame.arrived_ns - trigger))
    };
    let lates: Vec<(u64, u64)> = frames.iter().filter_map(late).collect();
    let enough =
        lates.len() == frames.len() && (triggers.len().max(2) - 1..=triggers.len()).contains(&frames.len());
    let mut once: Vec<u64> = lates.iter().map(|(trigger, _)| *trigger).collect();
    once.dedup();
    if !enough || once.len() != frames.len() {
        return None;
    }
    // A host that is slow to look makes a frame later, never earlier.
    let least = lates.iter().map(|(_, late)| *late).min()?;
    let head = usize::try_from(least.checked_sub(FIRST_NS)? / STEP_NS).ok().filter(|head| *head < heads)?;
    let edge = |trigger: u64| trigger + head_delay_ns(head);
    let after = |then: u64, trigger: u64| then as i64 - edge(trigger) as i64;
    let stamps: Option<Vec<i64>> = frames
        .iter()
        .zip(&lates)
        .map(|(frame, (trigger, _))| Some(after(frame.stamped_ns?, *trigger)))
        .collect();
    let arrivals = frames.iter().zip(&lates).map(|(frame, (trigger, _))| after(frame.arrived_ns, *trigger));
    Some(Delays {
        head,
        stamp_us: stamps.and_then(median).map(|ns| ns as f64 / 1000.0),
        arrival_us: median(arrivals.collect())? as f64 / 1000.0,
    })
}

#[cfg(test)]
mod tests {
    use super::{Delays, FrameTimes, head_delay_ns, period_ns, read};

    fn frames(triggers: &[u64], head: usize, stamp_ns: u64, arrival_ns: &[u64]) -> Vec<FrameTimes> {
        let frame = |(trigger, arrival): (&u64, &u64)| FrameTimes {
            arrived_ns: trigger + head_delay_ns(head) + arrival,
            stamped_ns: Some(trigger + head_delay_ns(head) + stamp_ns),
        };
        triggers.iter().zip(arrival_ns).map(frame).collect()
    }

    #[test]
    fn the_head_and_both_delays_are_read_from_three_pulses() {
        let triggers: Vec<u64> = (1..4).map(|k| k * period_ns(4)).collect();
        for head in 0..4 {
            let seen = frames(&triggers, head, 1_000_000, &[13_000_000, 14_000_000, 90_000_000]);
            let expected = Delays { head, stamp_us: Some(1000.0), arrival_us: 14_000.0 };
            assert_eq!(read(&triggers, &seen, 4), Some(expected));
            // The first frame after a pause may be missing, and stamps may not be there.
            let mut rest = seen[1..].to_vec();
            rest[0].stamped_ns = None;
            assert_eq!(
                read(&triggers, &rest, 4).map(|delays| (delays.head, delays.stamp_us)),
                Some((head, None))
            );
        }
    }

    #[test]
    fn frames_that_the_pulses_did_not_make_are_not_taken_for_theirs() {
        let triggers: Vec<u64> = (1..4).map(|k| k * period_ns(2)).collect();
        let seen = frames(&triggers, 1, 0, &[5_000_000; 3]);
        assert_eq!(read(&triggers, &[], 2), None, "dead");
        assert_eq!(read(&triggers, &seen[..1], 2), None, "one of three");
        let twice = [&seen[..], &seen[..]].concat();
        assert_eq!(read(&triggers, &twice, 2), None, "two a pulse");
        let early = FrameTimes { arrived_ns: triggers[0] - 1, stamped_ns: None };
        assert_eq!(read(&triggers, &[&[early], &seen[..2]].concat(), 2), None, "before the first pulse");
        let same = [seen[0], FrameTimes { arrived_ns: seen[0].arrived_ns + 1, stamped_ns: None }];
        assert_eq!(read(&triggers, &same, 2), None, "both of one pulse");
    }
}
