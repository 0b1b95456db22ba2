//! Which trigger a frame belongs to, by two witnesses: its block id and its timestamp.
//!
//! The block id counts frames that the camera made: a camera that ignored a trigger does not skip an id. The
//! timestamp, brought to the HSU's clock, names the trigger by its time: it would be fooled only by half a
//! trigger period. Where they disagree the timestamp wins, and the caller learns of it.

use crate::ids::{BlockId, TriggerIndex};

/// Times of the triggers so far, HSU clock, by index.
#[derive(Debug, Default)]
pub struct TriggerTable {
    times_ns: Vec<Option<u64>>,
    latest_ns: Option<u64>,
}

/// Longest table: eleven days at 120 Hz. A wild index must not allocate without bound.
const TRIGGERS_MAX: u64 = 120_000_000;

impl TriggerTable {
    /// Notes a trigger's time. Reports may come in any order and repeatedly; impossible indexes are ignored.
    pub fn insert(&mut self, trigger: TriggerIndex, hsu_ns: u64) {
        if trigger.0 >= TRIGGERS_MAX {
            return;
        }
        let index = trigger.0 as usize;
        if index >= self.times_ns.len() {
            self.times_ns.resize(index + 1, None);
        }
        self.times_ns[index] = Some(hsu_ns);
        self.latest_ns = self.latest_ns.max(Some(hsu_ns));
    }

    /// The time of a trigger.
    pub fn time_ns(&self, trigger: TriggerIndex) -> Option<u64> {
        self.times_ns.get(usize::try_from(trigger.0).ok()?).copied().flatten()
    }

    /// One more than the highest index reported.
    pub fn len(&self) -> u64 {
        self.times_ns.len() as u64
    }

    /// Whether nothing was reported yet.
    pub fn is_empty(&self) -> bool {
        self.times_ns.is_empty()
    }

    /// The first index below `len` that was never reported.
    pub fn first_hole(&self) -> Option<TriggerIndex> {
        self.times_ns.iter().position(Option::is_none).map(|i| TriggerIndex(i as u64))
    }

    /// The reported trigger nearest in time, and how far `hsu_ns` lies after it.
    fn nearest(&self, hsu_ns: i128) -> Option<(TriggerIndex, i128)> {
        // Times rise with the index; holes are stepped over, so search among what was reported.
        let after = self.times_ns.partition_point(|t| t.is_none_or(|t| i128::from(t) < hsu_ns));
        let around = after.saturating_sub(4)..(after + 4).min(self.times_ns.len());
        around
            .filter_map(|i| Some((TriggerIndex(i as u64), hsu_ns - i128::from(self.times_ns[i]?))))
            .min_by_key(|(_, residual)| residual.abs())
    }
}

/// Unwraps block ids: 16-bit ids count 1..=65535 and skip 0; wider ids do not wrap.
#[derive(Debug, Default)]
struct BlockIds {
    last: Option<(u64, u64)>,
}

const ID16_CYCLE: u64 = 65_535;

impl BlockIds {
    /// A count that rises by one per block, whatever the width. A step back of a wide id gives `None`.
    fn unwrap(&mut self, id: BlockId) -> Option<u64> {
        let count = match self.last {
            None => id.0,
            Some((last, count)) if last <= ID16_CYCLE && id.0 <= ID16_CYCLE => {
                let step = (id.0 + ID16_CYCLE - last) % ID16_CYCLE;
                // Up to half a cycle ahead is ahead; the rest is a repeated or late block.
                if step > ID16_CYCLE / 2 { count.checked_sub(ID16_CYCLE - step)? } else { count + step }
            }
            Some((last, count)) => (count + id.0).checked_sub(last)?,
        };
        if self.last.is_none_or(|(_, c)| count > c) {
            self.last = Some((id.0, count));
        }
        Some(count)
    }
}

/// How sure the match is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Witness {
    /// Block id and timestamp agree.
    Both,
    /// There is no timestamp or trigger time to confirm the block id.
    BlockIdOnly,
    /// The block id pointed at `expected`: between them the camera ignored triggers or made extra frames.
    Corrected {
        /// The trigger that the block id pointed at.
        expected: TriggerIndex,
    },
}

/// What a frame is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Match {
    /// The frame of this trigger.
    Trigger(TriggerIndex, Witness),
    /// The trigger table does not reach that far yet: ask again.
    Wait,
    /// No trigger is near its timestamp, this far from the nearest (ns).
    Spurious(i64),
    /// It came before the first trigger.
    BeforeTrain,
    /// A frame of this trigger, or of a later one, was matched already.
    Repeated(TriggerIndex),
}

/// What is known of a camera's clock before the first frame.
#[derive(Debug, Clone, Copy, Default)]
pub struct ClockRelation {
    /// The camera's clock minus the HSU's, ns, where the camera's can be read.
    pub camera_minus_hsu_ns: Option<i128>,
    /// The HSU's clock minus the host's (CLOCK_REALTIME), ns.
    pub hsu_minus_host_ns: Option<i128>,
}

/// Matches the frames of one camera, in the order in which they arrive.
#[derive(Debug)]
pub struct Matcher {
    period_ns: u64,
    /// Camera clock minus HSU clock, ns; refined by every frame that both witnesses agree on.
    offset_ns: Option<i128>,
    /// HSU clock minus host clock (CLOCK_REALTIME), ns: stands in for a camera clock that cannot be read.
    hsu_minus_host_ns: Option<i128>,
    refined: bool,
    ids: BlockIds,
    /// A block's count and its trigger.
    base: Option<(u64, u64)>,
    last: Option<TriggerIndex>,
    pending: Option<(BlockId, Option<u64>)>,
}

/// Share of a residual by which the clock offset follows: fast enough for 100 ppm at any rate above 1 Hz.
const FOLLOW_SHARE: i128 = 8;

impl Matcher {
    /// With what is known of the clocks before the session.
    pub fn new(period_ns: u64, clocks: ClockRelation) -> Self {
        Self {
            period_ns,
            offset_ns: clocks.camera_minus_hsu_ns,
            hsu_minus_host_ns: clocks.hsu_minus_host_ns,
            refined: false,
            ids: BlockIds::default(),
            base: None,
            last: None,
            pending: None,
        }
    }

    /// Names the trigger of a frame by its block id, its timestamp on the camera's clock and its arrival on
    /// the host's. While the answer is [`Match::Wait`], ask again with the same frame; with `last_call` the
    /// block id has to do without the timestamp.
    pub fn assign(
        &mut self,
        id: BlockId,
        camera_ns: u64,
        host_ns: u64,
        table: &TriggerTable,
        last_call: bool,
    ) -> Match {
        if let (None, Some(hsu_minus_host)) = (self.offset_ns, self.hsu_minus_host_ns) {
            self.offset_ns = Some(i128::from(camera_ns) - i128::from(host_ns) - hsu_minus_host);
        }
        if last_call && table.is_empty() {
            self.pending = None;
            return Match::BeforeTrain;
        }
        // A frame that is asked about again must not be counted again.
        let count = match self.pending.take() {
            Some((pending, count)) if pending == id => count,
            _ => self.ids.unwrap(id),
        };
        let by_id =
            self.base.zip(count).and_then(|((base, trigger), count)| (trigger + count).checked_sub(base));
        let by_time = match self.by_time(camera_ns, table, by_id) {
            ByTime::Beyond if !last_call => {
                self.pending = Some((id, count));
                return Match::Wait;
            }
            ByTime::Nothing(residual) => return Match::Spurious(residual),
            ByTime::Beyond | ByTime::Unknown => None,
            ByTime::Trigger(trigger) => Some(trigger),
        };
        // Without any witness the first frame after arming is the first trigger's.
        let (trigger, witness) = match (by_id, by_time) {
            (Some(id), Some(time)) if id == time.0 => (time, Witness::Both),
            (Some(id), Some(time)) => (time, Witness::Corrected { expected: TriggerIndex(id) }),
            (None, Some(time)) => (time, Witness::Both),
            (id, None) => (TriggerIndex(id.unwrap_or(0)), Witness::BlockIdOnly),
        };
        if let Some(last) = self.last.filter(|last| trigger <= *last) {
            return Match::Repeated(last);
        }
        self.last = Some(trigger);
        if let Some(count) = count {
            self.base = Some((count, trigger.0));
        }
        self.follow(trigger, camera_ns, table);
        Match::Trigger(trigger, witness)
    }

    fn by_time(&self, camera_ns: u64, table: &TriggerTable, by_id: Option<u64>) -> ByTime {
        let Some(offset_ns) = self.offset_ns else {
            let expected = TriggerIndex(by_id.unwrap_or(0));
            return if table.len() > expected.0 { ByTime::Unknown } else { ByTime::Beyond };
        };
        let hsu_ns = i128::from(camera_ns) - offset_ns;
        let half = i128::from(self.period_ns / 2);
        if table.latest_ns.is_none_or(|latest| hsu_ns > i128::from(latest) + half) {
            return ByTime::Beyond;
        }
        match table.nearest(hsu_ns) {
            Some((trigger, residual)) if residual.abs() <= half => ByTime::Trigger(trigger),
            Some((_, residual)) => ByTime::Nothing(i64::try_from(residual).unwrap_or(i64::MAX)),
            None => ByTime::Beyond,
        }
    }

    /// Lets the offset follow the frame; the first one replaces the coarse measurement.
    fn follow(&mut self, trigger: TriggerIndex, camera_ns: u64, table: &TriggerTable) {
        let Some(hsu_ns) = table.time_ns(trigger) else { return };
        let seen = i128::from(camera_ns) - i128::from(hsu_ns);
        self.offset_ns = Some(match self.offset_ns {
            Some(offset) if self.refined => offset + (seen - offset) / FOLLOW_SHARE,
            _ => seen,
        });
        self.refined = true;
    }
}

enum ByTime {
    Trigger(TriggerIndex),
    /// Too far from every trigger.
    Nothing(i64),
    /// Later than every trigger reported so far.
    Beyond,
    /// The clocks' relation is not known yet.
    Unknown,
}

#[cfg(test)]
mod tests {
    use super::{ClockRelation, Match, Matcher, TriggerTable, Witness};
    use crate::ids::{BlockId, TriggerIndex};
    use proptest::prelude::{ProptestConfig, any, prop_assert_eq, proptest};

    const PERIOD_NS: u64 = 8_333_333;

    fn table(count: u64) -> TriggerTable {
        let mut table = TriggerTable::default();
        (0..count).for_each(|k| table.insert(TriggerIndex(k), 1_000_000_000 + k * PERIOD_NS));
        table
    }

    fn camera_clock(offset_ns: i128) -> ClockRelation {
        ClockRelation { camera_minus_hsu_ns: Some(offset_ns), hsu_minus_host_ns: None }
    }

    fn id16(count: u64) -> BlockId {
        BlockId((count - 1) % 65_535 + 1)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        /// Ignored triggers, a drifting camera clock with jitter, and a 16-bit id that wraps: every frame
        /// still finds its own trigger.
        #[test]
        fn every_frame_finds_its_trigger(
            seed in any::<u64>(), first_id in 1u64..200_000, drift_ppm in -100i64..100, coarse_error_ns in -3_000_000i128..3_000_000,
        ) {
            let count = 2_000u64;
            let table = table(count);
            let offset = 5_000_000_000i64;
            let mut matcher = Matcher::new(PERIOD_NS, camera_clock(i128::from(offset) + coarse_error_ns));
            let mut state = seed | 1;
            let mut next = || { state ^= state << 13; state ^= state >> 7; state ^= state << 17; state };
            let mut id = first_id;
            for k in 0..count {
                if next() % 10 == 0 { continue; }
                let hsu = (1_000_000_000 + k * PERIOD_NS) as i64;
                let camera = hsu + offset + hsu * drift_ppm / 1_000_000 - 1_000 * drift_ppm + (next() % 400_000) as i64 - 200_000;
                match matcher.assign(id16(id), camera as u64, 0, &table, false) {
                    Match::Trigger(trigger, _) => prop_assert_eq!(trigger, TriggerIndex(k)),
                    other => prop_assert_eq!(format!("{other:?}"), format!("trigger {k}")),
                }
                id += 1;
            }
        }
    }

    #[test]
    fn an_ignored_trigger_is_told_from_a_lost_frame() {
        let table = table(10);
        let at = |k: u64| 1_000_000_000 + k * PERIOD_NS;
        let mut matcher = Matcher::new(PERIOD_NS, camera_clock(0));
        let first = matcher.assign(BlockId(1), at(0), 0, &table, false);
        assert_eq!(first, Match::Trigger(TriggerIndex(0), Witness::Both));
        // Frame lost on the way: the id skips with the time.
        let lost = matcher.assign(BlockId(3), at(2), 0, &table, false);
        assert_eq!(lost, Match::Trigger(TriggerIndex(2), Witness::Both));
        // Trigger ignored: the id does not skip.
        let ignored = matcher.assign(BlockId(4), at(4), 0, &table, false);
        let expected = TriggerIndex(3);
        assert_eq!(ignored, Match::Trigger(TriggerIndex(4), Witness::Corrected { expected }));
        let again = matcher.assign(BlockId(5), at(5), 0, &table, false);
        assert_eq!(again, Match::Trigger(TriggerIndex(5), Witness::Both));
    }

    #[test]
    fn frames_wait_for_their_trigger_and_are_not_counted_twice() {
        let mut matcher = Matcher::new(PERIOD_NS, camera_clock(0));
        let at = |k: u64| 1_000_000_000 + k * PERIOD_NS;
        assert_eq!(matcher.assign(BlockId(1), at(0), 0, &table(0), false), Match::Wait);
        assert_eq!(matcher.assign(BlockId(1), at(0), 0, &table(0), false), Match::Wait);
        let first = matcher.assign(BlockId(1), at(0), 0, &table(1), false);
        assert_eq!(first, Match::Trigger(TriggerIndex(0), Witness::Both));
        // The trigger's report is lost for good: the block id must do.
        let second = matcher.assign(BlockId(2), at(1), 0, &table(1), true);
        assert_eq!(second, Match::Trigger(TriggerIndex(1), Witness::BlockIdOnly));
    }

    #[test]
    fn spurious_and_repeated_frames_are_refused() {
        let table = table(10);
        let mut matcher = Matcher::new(PERIOD_NS, camera_clock(0));
        let at = |k: u64| 1_000_000_000 + k * PERIOD_NS;
        assert!(matches!(
            matcher.assign(BlockId(1), at(0) - 2 * PERIOD_NS, 0, &table, false),
            Match::Spurious(_)
        ));
        assert!(matches!(matcher.assign(BlockId(2), at(3), 0, &table, false), Match::Trigger(..)));
        let repeated = matcher.assign(BlockId(2), at(3), 0, &table, false);
        assert_eq!(repeated, Match::Repeated(TriggerIndex(3)));
    }

    #[test]
    fn a_camera_without_a_readable_clock_is_matched_by_arrival() {
        // Host clock runs 7 s behind the HSU's; the frames arrive 2 ms after their triggers.
        let clocks = ClockRelation { camera_minus_hsu_ns: None, hsu_minus_host_ns: Some(7_000_000_000) };
        let mut matcher = Matcher::new(PERIOD_NS, clocks);
        let hsu = |k: i64| (8_000_000_000 + k * PERIOD_NS as i64) as u64;
        let host = |k: i64| hsu(k) - 7_000_000_000 + 2_000_000;
        let camera = |k: i64| (500_000_000_000 + k * PERIOD_NS as i64) as u64;
        // A free-running camera sends before the first trigger, while nothing is reported yet and after.
        let empty = TriggerTable::default();
        let early = matcher.assign(BlockId(1), camera(-60), host(-60), &empty, true);
        assert_eq!(early, Match::BeforeTrain);
        let mut table = TriggerTable::default();
        (0..5).for_each(|k| table.insert(TriggerIndex(k), hsu(k as i64)));
        assert!(matches!(
            matcher.assign(BlockId(60), camera(-1), host(-1), &table, false),
            Match::Spurious(_)
        ));
        for k in 0..5 {
            let found = matcher.assign(BlockId(61 + k), camera(k as i64), host(k as i64), &table, false);
            assert_eq!(found, Match::Trigger(TriggerIndex(k), Witness::Both));
        }
    }
}
