// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which triggers a node samples for the live body, and the rows of the last ones: pure, times are given, on any clock
//! that does not jump.
//!
//! Nodes need no message to agree: triggers that are multiples of a stride are sampled. Numbers begin anew with each
//! session, so frames that are older than a pause between sessions are neither returned nor waited for.

use crate::acquire::preview::Sample;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// Most frame sets that are sampled in a second.
const MOST_PER_S: f64 = 15.0;
/// Number of triggers whose rows are kept.
const KEPT: usize = 6;

/// The rows of some cameras, by their place.
pub(super) type Places = BTreeMap<usize, Arc<Sample>>;

/// Rows of this node's cameras, and which ones are wanted next.
#[derive(Debug)]
pub(super) struct Kept {
    stride: u64,
    /// Frames so far apart are not of one session, ns.
    apart_ns: u64,
    /// The last frame sets by trigger, oldest first.
    sets: VecDeque<Set>,
    wishes: Vec<Wish>,
    /// Samples whose memory can be used again.
    spares: Vec<Sample>,
}

#[derive(Debug)]
struct Set {
    trigger: u64,
    /// When its last frame was taken, ns.
    taken_ns: u64,
    places: Places,
}

#[derive(Debug, Clone, Copy, Default)]
struct Wish {
    from: u64,
    /// When the request was sent, ns; `None` before that.
    requested_ns: Option<u64>,
}

impl Kept {
    pub(super) fn new(cameras: usize, trigger_rate_hz: f64) -> Self {
        let stride = (trigger_rate_hz / MOST_PER_S).ceil().max(1.0) as u64;
        Self {
            stride,
            apart_ns: (3e9 * stride as f64 / trigger_rate_hz).max(1e9) as u64,
            sets: VecDeque::new(),
            wishes: vec![Wish::default(); cameras],
            spares: Vec::new(),
        }
    }

    /// From which trigger on the next frame of a camera is wanted, where that has to be requested now.
    pub(super) fn wish(&mut self, camera: usize, now_ns: u64) -> Option<u64> {
        let apart_ns = self.apart_ns;
        let wish = self.wishes.get_mut(camera)?;
        match wish.requested_ns {
            Some(requested_ns) if requested_ns + apart_ns > now_ns => return None,
            // In the next session numbers begin anew.
            Some(_) => wish.from = 0,
            None => {}
        }
        wish.requested_ns = Some(now_ns);
        Some(wish.from)
    }

    /// No client looks any more: requests that were sent are void.
    pub(super) fn forget_wishes(&mut self) {
        self.wishes.fill(Wish::default());
    }

    /// Memory for a sample, if some is left over.
    pub(super) fn spare(&mut self) -> Option<Sample> {
        self.spares.pop()
    }

    /// Takes the memory of a sample back for the next one.
    pub(super) fn give_back(&mut self, sample: Option<Sample>) {
        self.spares.extend(sample.filter(|_| self.spares.len() < KEPT * self.wishes.len()));
    }

    /// Keeps a sample if its trigger is one of those that all nodes sample.
    pub(super) fn keep(&mut self, camera: usize, sample: Sample, now_ns: u64) {
        let trigger = sample.trigger;
        if let Some(wish) = self.wishes.get_mut(camera) {
            *wish = Wish {
                from: (trigger / self.stride).saturating_add(1).saturating_mul(self.stride),
                requested_ns: None,
            };
        }
        if !trigger.is_multiple_of(self.stride) {
            return self.give_back(Some(sample));
        }
        // After a pause, or with numbers that begin anew, it is the next session.
        let of_another = |newest: &Set| {
            trigger.saturating_add(3 * self.stride) <= newest.trigger
                || newest.taken_ns.saturating_add(self.apart_ns) <= now_ns
        };
        if self.sets.back().is_some_and(of_another) {
            (0..self.sets.len()).for_each(|_| self.drop_oldest());
        }
        let place = self.sets.partition_point(|set| set.trigger < trigger);
        if self.sets.get(place).is_none_or(|set| set.trigger != trigger) {
            self.sets.insert(place, Set { trigger, taken_ns: now_ns, places: Places::new() });
        }
        let set = &mut self.sets[place];
        set.taken_ns = now_ns;
        set.places.insert(camera, Arc::new(sample));
        while self.sets.len() > KEPT {
            self.drop_oldest();
        }
    }

    fn drop_oldest(&mut self) {
        let Some(Set { places, .. }) = self.sets.pop_front() else { return };
        // What is still being looked at is freed there.
        places.into_values().for_each(|sample| self.give_back(Arc::into_inner(sample)));
    }

    /// The newest trigger of which all cameras are there, or some have been given up; `None` where that is `last`.
    pub(super) fn newest(&self, last: Option<u64>) -> Option<u64> {
        let cameras = self.wishes.len();
        let whole = self.sets.iter().rev().find(|set| set.places.len() == cameras).map(|set| set.trigger);
        // Where a camera is away for good, what lies two strides back will not become whole.
        let behind = self.sets.iter().rev().nth(2).map(|set| set.trigger);
        whole.max(behind).filter(|trigger| last != Some(*trigger))
    }

    /// What there is of a trigger of the session that runs now.
    pub(super) fn of(&self, trigger: u64, now_ns: u64) -> Option<Places> {
        let set = self.sets.iter().find(|set| set.trigger == trigger)?;
        (set.taken_ns.saturating_add(self.apart_ns) > now_ns).then(|| set.places.clone())
    }

    /// The same once nothing more is to come: all cameras are there, or a later trigger is.
    pub(super) fn settled(&self, trigger: u64, now_ns: u64) -> Option<Places> {
        let later = self.sets.back().is_some_and(|newest| newest.trigger > trigger);
        self.of(trigger, now_ns).filter(|places| later || places.len() == self.wishes.len())
    }
}

#[cfg(test)]
mod tests {
    use super::{KEPT, Kept};
    use crate::acquire::preview::Sample;

    const MS: u64 = 1_000_000;

    fn sample(trigger: u64) -> Sample {
        Sample { trigger, width: 1, pixels: vec![0], ..Sample::default() }
    }

    /// Two cameras at 120 Hz: each eighth trigger. Frame sets of these triggers have come.
    fn after(triggers: &[u64]) -> Kept {
        let mut kept = Kept::new(2, 120.0);
        for trigger in triggers {
            (0..2).for_each(|camera| kept.keep(camera, sample(*trigger), trigger.saturating_mul(8 * MS)));
        }
        kept
    }

    #[test]
    fn all_nodes_sample_the_multiples_of_the_stride() {
        let mut kept = after(&[3]);
        assert_eq!(kept.newest(None), None, "3 is none of them");
        assert_eq!(kept.wish(0, 0), Some(8));
        assert_eq!(kept.wish(0, 1), None, "that stands");
        kept.keep(0, sample(8), 64 * MS);
        assert_eq!(kept.wish(0, 64 * MS), Some(16));
        assert_eq!(Kept::new(1, 10.0).stride, 1, "a slow train is sampled whole");
        let mut last = after(&[u64::MAX]);
        assert_eq!(last.wish(0, 0), Some(u64::MAX), "and no number is too large");
    }

    #[test]
    fn what_the_last_session_was_waiting_for_is_not_waited_for_in_the_next() {
        let mut kept = after(&[7200]);
        let end = 57_600 * MS;
        assert_eq!(kept.wish(0, end), Some(7208));
        assert_eq!(kept.wish(0, end + 900 * MS), None);
        assert_eq!(kept.wish(0, end + 1000 * MS), Some(0));
        kept.forget_wishes();
        assert_eq!(kept.wish(0, end + 1001 * MS), Some(0));
    }

    #[test]
    fn rows_of_the_last_session_are_not_given_as_those_of_the_next() {
        let mut kept = after(&[0, 8, 16]);
        let end = 128 * MS;
        assert!(kept.of(8, end).is_some_and(|places| places.len() == 2));
        assert_eq!(kept.of(8, end + 5000 * MS), None, "as long as the next has not come here");
        kept.keep(0, sample(0), end + 5000 * MS);
        assert_eq!(kept.of(8, end + 5000 * MS), None);
        assert_eq!(kept.of(0, end + 5000 * MS).map(|places| places.len()), Some(1));
    }

    #[test]
    fn a_set_is_given_when_it_is_whole_or_nothing_more_is_to_come() {
        let mut kept = after(&[0]);
        assert_eq!((kept.newest(None), kept.newest(Some(0))), (Some(0), None));
        for trigger in [8, 16, 24] {
            kept.keep(0, sample(trigger), 8 * MS * trigger);
        }
        assert_eq!(kept.newest(Some(0)), Some(8), "the other camera is away");
        let now = 192 * MS;
        assert_eq!(kept.settled(24, now), None, "it may yet come");
        assert_eq!(kept.settled(16, now).map(|places| places.len()), Some(1));
        assert_eq!(kept.settled(32, now), None);
    }

    #[test]
    fn memory_is_bounded_and_comes_back() {
        let triggers: Vec<u64> = (0..50).map(|i| 8 * i).collect();
        let mut kept = after(&triggers);
        assert_eq!(kept.sets.len(), KEPT);
        assert_eq!(kept.spares.len(), 2 * KEPT);
        assert!(kept.spare().is_some());
    }
}
