// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the disk does with each call: how long it takes, how much it takes, when it fails. Knows no file system.

use super::plan::{Drawn, Operation};
use crate::random::{hash, share};
use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

/// Bytes of a block: files take room in whole blocks.
pub const BLOCK: u64 = 4096;

/// What becomes of a write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WriteOutcome {
    /// Which write to the disk it is, from 1 on.
    pub number: u64,
    /// So many of its bytes reach the file, whatever is answered.
    pub taken: u64,
    /// What is answered instead of `taken`.
    pub errno: Option<i32>,
    /// It was cut short or refused for want of room.
    pub full: bool,
    /// The time that the answer takes.
    pub delay: Duration,
    /// Nothing of this file was delayed before.
    pub first_delay: bool,
    /// The first write to this file, on a disk of limited size.
    pub limited: bool,
}

/// One simulated disk: its room, its speed and its faults.
#[derive(Debug)]
pub struct Medium {
    drawn: Drawn,
    /// Room that each file takes.
    held: BTreeMap<u64, u64>,
    used: u64,
    writes: u64,
    syncs: u64,
    /// Bytes that all files take together.
    bytes: u64,
    busy_until: Option<Instant>,
    slowed: BTreeSet<u64>,
    written: BTreeSet<u64>,
    gone: bool,
}

impl Medium {
    /// An empty disk with these faults.
    pub fn new(drawn: Drawn) -> Self {
        Self {
            drawn,
            held: BTreeMap::new(),
            used: 0,
            writes: 0,
            syncs: 0,
            bytes: 0,
            busy_until: None,
            slowed: BTreeSet::new(),
            written: BTreeSet::new(),
            gone: false,
        }
    }

    /// No faults any more: as if the disk were read elsewhere.
    pub fn repair(&mut self) {
        self.gone = false;
        self.drawn.slow = None;
        self.drawn.capacity = None;
        self.drawn.faults.clear();
    }

    /// What is there now is all that it holds.
    pub fn fill(&mut self) {
        (self.drawn.capacity, self.drawn.announced) = (Some(self.used), None);
    }

    /// Whether the disk is gone, so that every change fails.
    pub fn is_gone(&self) -> bool {
        self.gone
    }

    /// Bytes that it reports in all, and that are free; `None` where nothing bounds it.
    pub fn room(&self) -> Option<(u64, u64)> {
        let all = self.drawn.announced.or(self.drawn.capacity)?;
        Some((all, all.saturating_sub(self.used)))
    }

    /// Bytes of room that this file takes.
    pub fn held(&self, file: u64) -> u64 {
        self.held.get(&file).copied().unwrap_or(0)
    }

    /// A write of `length` bytes at `offset`.
    pub fn write(&mut self, file: u64, offset: u64, length: u64, now: Instant) -> WriteOutcome {
        self.writes += 1;
        let delay = self.delay(length, now);
        let first_delay = !delay.is_zero() && self.slowed.insert(file);
        let mut outcome = WriteOutcome {
            number: self.writes,
            taken: length,
            errno: None,
            full: false,
            delay,
            first_delay,
            limited: self.written.insert(file) && self.drawn.capacity.is_some(),
        };
        if self.gone {
            return WriteOutcome { taken: 0, errno: Some(libc::EIO), ..outcome };
        }
        if let Some(taken) = self.write_fault(length) {
            // Part of it reached the medium all the same.
            (outcome.taken, outcome.errno) = (taken, Some(libc::EIO));
        }
        let fits = self.fitting(file, offset, outcome.taken);
        if fits < outcome.taken {
            outcome.full = true;
            outcome.taken = fits;
            if fits == 0 {
                outcome.errno = Some(outcome.errno.unwrap_or(libc::ENOSPC));
            }
        }
        if outcome.taken > 0 {
            self.hold(file, offset.saturating_add(outcome.taken));
        }
        self.bytes += outcome.taken;
        outcome
    }

    fn delay(&mut self, length: u64, now: Instant) -> Duration {
        let Some(slow) = self.drawn.slow.as_ref().filter(|_| self.bytes >= self.drawn.slow_from) else {
            return Duration::ZERO;
        };
        let transfer = slow
            .bytes_per_s
            .map_or(Duration::ZERO, |rate| Duration::from_secs_f64(length as f64 / rate as f64));
        // One write after the other, as with one head.
        let start = self.busy_until.map_or(now, |busy| busy.max(now));
        let end = start + slow.latency(self.drawn.chance, self.writes) + transfer;
        self.busy_until = Some(end);
        end.saturating_duration_since(now)
    }

    /// If this write fails: how many bytes reach the medium.
    fn write_fault(&mut self, length: u64) -> Option<u64> {
        let (chance, writes, bytes) = (self.drawn.chance, self.writes, self.bytes);
        for (number, fault) in (0u64..).zip(&mut self.drawn.faults) {
            if fault.on != Operation::Write || fault.over {
                continue;
            }
            let taken = match (fault.at_byte, fault.nth) {
                (Some(at), _) if at < bytes.saturating_add(length) => Some(at.saturating_sub(bytes)),
                (None, Some(nth)) if nth == writes => Some(hash(chance, &[writes, 1]) % (length + 1)),
                (None, None) if happens(chance, number, writes, fault.probability) => {
                    Some(hash(chance, &[writes, 1]) % (length + 1))
                }
                _ => None,
            };
            if taken.is_some() {
                fault.over = fault.nth.is_some() || fault.at_byte.is_some();
                self.gone |= fault.for_good;
                return taken;
            }
        }
        None
    }

    /// An `fdatasync`: which one it is, and whether it fails.
    pub fn sync(&mut self) -> (u64, bool) {
        self.syncs += 1;
        if self.gone {
            return (self.syncs, true);
        }
        let (chance, syncs) = (self.drawn.chance, self.syncs);
        for (number, fault) in (0u64..).zip(&mut self.drawn.faults) {
            if fault.on != Operation::Sync || fault.over {
                continue;
            }
            let due = match fault.nth {
                Some(nth) => nth == syncs,
                None => happens(chance, number, syncs, fault.probability),
            };
            if due {
                fault.over = fault.nth.is_some();
                self.gone |= fault.for_good;
                return (syncs, true);
            }
        }
        (syncs, false)
    }

    /// Sets room aside up to `end`; `false` when there is not as much.
    pub fn set_aside(&mut self, file: u64, end: u64) -> bool {
        if self.fitting(file, 0, end) < end {
            return false;
        }
        self.hold(file, end);
        true
    }

    /// The file ends here now, or is no more: what is beyond is free again.
    pub fn cut(&mut self, file: u64, length: u64) {
        let kept = length.next_multiple_of(BLOCK).min(self.held(file));
        self.used -= self.held(file) - kept;
        self.held.insert(file, kept);
    }

    /// How many of `length` bytes at `offset` find room.
    fn fitting(&self, file: u64, offset: u64, length: u64) -> u64 {
        let Some(capacity) = self.drawn.capacity else { return length };
        let end = self.held(file).saturating_add(capacity.saturating_sub(self.used));
        end.saturating_sub(offset).min(length)
    }

    /// The file takes room up to `end`, in whole blocks where there are any left.
    fn hold(&mut self, file: u64, end: u64) {
        let held = self.held(file);
        let whole = end.next_multiple_of(BLOCK);
        let wanted = self.fitting(file, 0, whole).max(held);
        if end > held {
            self.used += wanted - held;
            self.held.insert(file, wanted);
        }
    }
}

/// Whether a fault happens at one call, by chance.
fn happens(chance: u64, fault: u64, call: u64, probability: f64) -> bool {
    share(hash(chance, &[fault, call, 2])) < probability
}

#[cfg(test)]
mod tests {
    use super::super::plan::DiskPlan;
    use super::*;
    use proptest::prelude::*;

    fn medium(text: &str) -> Medium {
        let plan = DiskPlan::parse(&format!("[disk]\nseed = 4\n{text}")).expect("valid").expect("there");
        Medium::new(plan.drawn("a"))
    }

    #[test]
    fn without_a_plan_nothing_happens() {
        let mut medium = medium("");
        let now = Instant::now();
        for n in 1..500 {
            let outcome = medium.write(1, n * 7777, 7777, now);
            let plain = WriteOutcome {
                number: n,
                taken: 7777,
                errno: None,
                full: false,
                delay: Duration::ZERO,
                first_delay: false,
                limited: false,
            };
            assert_eq!((outcome, medium.sync()), (plain, (n, false)));
        }
        assert_eq!(medium.room(), None);
        assert!(medium.set_aside(1, u64::MAX / 2));
    }

    #[test]
    fn it_is_full_at_the_byte() {
        let mut medium = medium("[disk.full]\ncapacity_bytes = 20_100\nannounced_bytes = 1_000_000\n");
        let now = Instant::now();
        assert_eq!(medium.write(1, 0, 5000, now).taken, 5000);
        assert_eq!(medium.room(), Some((1_000_000, 1_000_000 - 8192)));
        // The same block again needs no more room.
        assert_eq!(medium.write(1, 4096, 4096, now).taken, 4096);
        let short = medium.write(2, 0, 16_384, now);
        assert_eq!((short.taken, short.errno, short.full), (20_100 - 8192, None, true));
        let refused = medium.write(2, short.taken, 100, now);
        assert_eq!((refused.taken, refused.errno), (0, Some(libc::ENOSPC)));
        medium.cut(2, 4097);
        let again = medium.write(3, 0, 9000, now);
        assert_eq!(again.taken, 20_100 - 2 * 8192);
        medium.cut(1, 0);
        assert!(medium.set_aside(3, 8192) && !medium.set_aside(3, 1 << 20));
    }

    #[test]
    fn errors_come_when_they_are_planned() {
        let now = Instant::now();
        let mut once = medium("[[disk.error]]\non = \"write\"\nat_byte = 1000\n");
        assert_eq!(once.write(1, 0, 1000, now).errno, None);
        let failed = once.write(1, 1000, 500, now);
        assert_eq!((failed.taken, failed.errno), (0, Some(libc::EIO)));
        assert_eq!(once.write(1, 1000, 500, now).errno, None, "once");
        let mut gone = medium("[[disk.error]]\non = \"sync\"\nnth = 3\nfor_good = true\n");
        let syncs: Vec<bool> = (0..4).map(|_| gone.sync().1).collect();
        assert_eq!(syncs, [false, false, true, true]);
        assert!(gone.is_gone() && gone.write(1, 0, 10, now).errno == Some(libc::EIO));
        gone.repair();
        assert!(!gone.sync().1 && gone.write(1, 0, 10, now).errno.is_none());
        let mut seldom = medium("[[disk.error]]\non = \"write\"\nprobability = 0.1\n");
        let failed = (0..2000).filter(|n| seldom.write(1, n * 10, 10, now).errno.is_some()).count();
        assert!((140..260).contains(&failed), "{failed} of 2000");
    }

    #[test]
    fn what_goes_through_is_bounded() {
        let mut medium = medium("[disk.slow]\nbytes_per_s = 1000\nfrom_byte = 500\n");
        let now = Instant::now();
        assert!(medium.write(1, 0, 500, now).delay.is_zero());
        let (first, second) = (medium.write(1, 500, 250, now), medium.write(1, 750, 250, now));
        assert_eq!((first.delay.as_millis(), second.delay.as_millis()), (250, 500));
        assert!(first.first_delay && !second.first_delay);
    }

    proptest! {
        /// Room is never given twice and never lost.
        #[test]
        fn room_is_conserved(
            capacity in 1u64..60_000,
            steps in prop::collection::vec((0u64..3, 0u64..30_000, 0u64..20_000, 0u8..3), 0..60),
        ) {
            let mut medium = medium(&format!("[disk.full]\ncapacity_bytes = {capacity}\n"));
            for (file, offset, length, what) in steps {
                match what {
                    0 => medium.cut(file, offset),
                    1 => drop(medium.set_aside(file, length)),
                    _ => {
                        let outcome = medium.write(file, offset, length, Instant::now());
                        prop_assert!(outcome.taken == 0 || offset + outcome.taken <= medium.held(file));
                    }
                }
                let all: u64 = (0..3).map(|file| medium.held(file)).sum();
                prop_assert_eq!(medium.room(), Some((capacity, capacity - all)));
            }
        }
    }
}
