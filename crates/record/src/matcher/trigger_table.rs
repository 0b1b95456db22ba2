// SPDX-License-Identifier: MIT OR Apache-2.0
//! Times of the triggers so far, warm-up included: number to HSU time and back.

use hsu_firmware_proto::PAUSE_BEFORE;
use std::collections::VecDeque;

/// One trigger's time. Where its report is missing or contradicts the train's rhythm, `hsu_ns` is inferred from cameras
/// or calculated from the sound reports around it.
#[derive(Debug, Clone, Copy)]
struct Row {
    hsu_ns: u64,
    /// Reported, and in rhythm with the reports before.
    sound: bool,
    /// Whether the HSU reported it, in rhythm or not.
    has_report: bool,
    /// Not reported, and cameras agree on it.
    agreed: bool,
}

impl Row {
    fn reported(hsu_ns: u64, sound: bool) -> Self {
        Self { hsu_ns, sound, has_report: true, agreed: false }
    }

    fn calculated(hsu_ns: u64) -> Self {
        Self { hsu_ns, sound: false, has_report: false, agreed: false }
    }

    fn is_known(&self) -> bool {
        self.sound || self.agreed
    }
}

/// Times of the triggers so far, HSU clock, by number; warm-up triggers have negative numbers. The recorder's
/// accounting owns one for each session and fills it from the HSU's reports; matchers read it.
///
/// The HSU's times are a source of their own and can be wrong. Their rhythm shows it (`hsu-protocol.md`): two triggers
/// are at least 7/8 of a period apart, one that comes later than it should is flagged, and no report arrives before its
/// trigger was fired. A report that contradicts this is kept out: its trigger counts as not reported, and so do those
/// behind it, until a report is in rhythm with the last sound one again.
#[derive(Debug, Default)]
pub struct TriggerTable {
    /// 0: the rhythm is not known, and any times in order are taken.
    period_ns: u64,
    first: i64,
    rows: VecDeque<Row>,
    anchor: Option<Anchor>,
    /// Reports that contradict the rhythm.
    contradicting: u64,
}

/// The last sound report, and what was reported behind it.
#[derive(Debug, Clone, Copy)]
struct Anchor {
    number: i64,
    hsu_ns: u64,
    /// Mean of the steps of single triggers that were in time, ns.
    step_ns: f64,
    /// How long the train pauses, ns, as far as one pause was seen.
    pause_ns: Option<i128>,
    /// Reports behind it contradict the rhythm.
    contradicted: bool,
    /// One of them was flagged as late.
    late: bool,
}

/// Longest table: eleven days at 120 Hz. A wild number must not allocate without bound.
const TRIGGERS_MAX: i64 = 120_000_000;
const WARM_UP_MAX: i64 = 1_000_000;
/// Most reports that may be missing in a row: it bounds the memory that a wrong number costs.
const HOLE_MAX: i64 = 1_000_000;

impl TriggerTable {
    /// For a train of this period.
    pub fn new(period_ns: u64) -> Self {
        Self { period_ns, ..Self::default() }
    }

    /// Notes a reported time. `late`: the HSU flags it as late; `possible`: it did not arrive before that time. Reports
    /// may be repeated, and missing ones may come later. Numbers out of all bounds are ignored.
    pub fn report(&mut self, number: i64, hsu_ns: u64, late: bool, possible: bool) {
        if !(-WARM_UP_MAX..TRIGGERS_MAX).contains(&number) {
            return;
        }
        if self.rows.is_empty() {
            (self.first, self.contradicting) = (number, u64::from(!possible));
            self.rows.push_back(Row::reported(hsu_ns, possible));
            self.anchor = possible.then_some(Anchor::at(number, hsu_ns, self.period_ns as f64));
            return;
        }
        if number < self.first {
            return self.insert_before(number, hsu_ns, possible);
        }
        if number - self.end() + 1 > HOLE_MAX {
            return;
        }
        let Some(anchor) = self.anchor else { return self.begin_again(number, hsu_ns, possible) };
        if number <= anchor.number {
            return self.fill(number, hsu_ns, possible);
        }
        let known = (number < self.end()).then(|| self.rows[(number - self.first) as usize]);
        if known.is_some_and(|row| row.has_report) {
            return;
        }
        if !possible || !self.is_in_rhythm(&anchor, number, hsu_ns, late) {
            self.contradicting += 1;
            let anchor = Anchor { contradicted: true, late: anchor.late || late, ..anchor };
            self.anchor = Some(anchor);
            self.grow_to(number, |steps| anchor.expected_ns(steps));
            self.rows[(number - self.first) as usize].has_report = true;
            return;
        }
        let span = hsu_ns - anchor.hsu_ns;
        let ahead = number - anchor.number;
        self.grow_to(number, |_| hsu_ns);
        self.spread(number, hsu_ns);
        self.rows[(number - self.first) as usize] = Row::reported(hsu_ns, true);
        let in_time = ahead == 1 && !late && !PAUSE_BEFORE.contains(&number);
        let share = if in_time { 1.0 / 16.0 } else { 0.0 };
        let step_ns = anchor.step_ns + (span as f64 - anchor.step_ns) * share;
        let paused = ahead == 1 && !late && PAUSE_BEFORE.contains(&number) && self.period_ns > 0;
        let pause_ns =
            || i128::from(if span * 4 > self.period_ns * 7 { self.period_ns } else { self.period_ns / 2 });
        let pause_ns = anchor.pause_ns.or_else(|| (paused && span * 4 > self.period_ns * 5).then(pause_ns));
        self.anchor = Some(Anchor { pause_ns, ..Anchor::at(number, hsu_ns, step_ns) });
    }

    /// Rows up to a trigger; `hsu_ns` calculates the time of one by its distance from the last sound report, in
    /// triggers.
    fn grow_to(&mut self, number: i64, hsu_ns: impl Fn(i64) -> u64) {
        let anchor = self.anchor.map_or(self.first, |anchor| anchor.number);
        while self.end() <= number {
            let hsu_ns = hsu_ns(self.end() - anchor);
            self.rows.push_back(Row::calculated(hsu_ns));
        }
    }

    /// Triggers without a report before one with a time lie evenly behind the last time that is known.
    fn spread(&mut self, number: i64, hsu_ns: u64) {
        let end = (number - self.first) as usize;
        let known = |row: &Row| row.is_known() && row.hsu_ns < hsu_ns;
        let Some(start) = (0..end).rev().find(|place| known(&self.rows[*place])) else { return };
        let from = self.rows[start].hsu_ns;
        let (span, steps) = (u128::from(hsu_ns - from), (end - start) as u128);
        for (row, k) in self.rows.range_mut(start + 1..end).zip(1..) {
            row.hsu_ns = from + (span * k / steps) as u64;
        }
    }

    /// Whether a report is in rhythm with the last sound one.
    fn is_in_rhythm(&self, anchor: &Anchor, number: i64, hsu_ns: u64, late: bool) -> bool {
        let (period, steps) = (i128::from(self.period_ns), i128::from(number - anchor.number));
        let span = i128::from(hsu_ns) - i128::from(anchor.hsu_ns);
        if period == 0 {
            return span > 0;
        }
        // With the projectors' frame sync a pause lasts until the next of their frames.
        let pauses =
            PAUSE_BEFORE.iter().filter(|pause| (anchor.number + 1..=number).contains(*pause)).count() as i128;
        if anchor.contradicted {
            // Back in the old rhythm, and nowhere else: a step that is a period off would else be taken after some
            // triggers.
            let plain = span - (anchor.step_ns * steps as f64) as i128;
            let pause = |ns: i128| (plain - pauses * ns).abs() <= period / 8;
            let paused = anchor.pause_ns.map_or_else(|| pause(period / 2) || pause(period), pause);
            return !anchor.late && !late && paused;
        }
        let least = if steps == 1 { period * 7 / 8 } else { steps * (period - period / 512) - period / 8 };
        // Of reports that are missing between them some may be late.
        let late = late || steps > 1;
        let on = |step: i128| (span - step).abs() <= period / 8;
        let paused = anchor.pause_ns.map_or_else(
            || on(period) || on(period * 3 / 2) || on(period * 2),
            |ns| on(period) || on(period + ns),
        );
        let in_time = if pauses > 0 { paused } else { on(period) };
        span >= least && (late || in_time)
    }

    /// The first sound report, behind others that were not.
    fn begin_again(&mut self, number: i64, hsu_ns: u64, possible: bool) {
        self.grow_to(number, |_| hsu_ns);
        let row = &mut self.rows[(number - self.first) as usize];
        *row = Row::reported(hsu_ns, possible);
        self.contradicting += u64::from(!possible);
        self.anchor = possible.then_some(Anchor::at(number, hsu_ns, self.period_ns as f64));
    }

    /// A report that was missing: its time must lie between those of its neighbours.
    fn fill(&mut self, number: i64, hsu_ns: u64, possible: bool) {
        let place = (number - self.first) as usize;
        let apart = |row: &Row| if row.sound { self.period_ns * 7 / 8 } else { 0 };
        let before = place.checked_sub(1).and_then(|place| self.rows.get(place));
        let after_last = before.is_none_or(|row| hsu_ns >= row.hsu_ns.saturating_add(apart(row)));
        let after = self.rows.get(place + 1);
        let before_next = after.is_none_or(|row| hsu_ns.saturating_add(apart(row)) <= row.hsu_ns);
        if !self.rows[place].has_report && possible && after_last && before_next {
            self.rows[place] = Row::reported(hsu_ns, true);
        }
    }

    /// A report of a trigger before the first one that was reported.
    fn insert_before(&mut self, number: i64, hsu_ns: u64, possible: bool) {
        let Some(first) = self.rows.front().map(|row| row.hsu_ns).filter(|first| hsu_ns < *first) else {
            return;
        };
        let missing = self.first - number;
        let span = u128::from(first - hsu_ns);
        for k in (1..missing).rev() {
            let between = (span * k as u128 / missing as u128) as u64;
            self.rows.push_front(Row::calculated(hsu_ns + between));
        }
        self.rows.push_front(Row::reported(hsu_ns, possible));
        self.first = number;
    }

    /// Reports that contradict the rhythm, so far.
    pub fn contradicting(&self) -> u64 {
        self.contradicting
    }

    /// Whether the triggers from `first` to the first of the session have a rhythm: longer pauses between some of them.
    pub fn has_rhythm(&self, first: i64, period_ns: u64) -> bool {
        let pause = |number: i64| Some(self.time_ns(number + 1)? - self.time_ns(number)?);
        (first..0).filter_map(pause).any(|ns| (period_ns / 4 * 5..period_ns / 4 * 9).contains(&ns))
    }

    /// Whether the HSU reported a trigger, in rhythm or not.
    pub fn has_report(&self, number: i64) -> bool {
        self.row(number).is_some_and(|row| row.has_report)
    }

    /// Whether cameras agree on the time of a trigger that was not reported.
    pub fn is_agreed(&self, number: i64) -> bool {
        self.row(number).is_some_and(|row| row.agreed)
    }

    /// Notes a trigger whose report is held up, or missing between others, from what cameras agree on; its report, once
    /// there, replaces it.
    pub fn infer(&mut self, number: i64, hsu_ns: u64) {
        if number < self.end() {
            return self.infer_between(number, hsu_ns);
        }
        let Some(last) = self.rows.back().map(|row| row.hsu_ns) else { return };
        let ahead = number.saturating_sub(self.end()).saturating_add(1);
        if !(1..=HOLE_MAX).contains(&ahead) || hsu_ns <= last {
            return;
        }
        self.grow_to(number, |_| hsu_ns);
        self.rows[(number - self.first) as usize].agreed = true;
        self.spread(number, hsu_ns);
    }

    /// Between two reports triggers need not lie evenly: one may have been late. No two are closer than 7/8 of a
    /// period.
    fn infer_between(&mut self, number: i64, hsu_ns: u64) {
        let Some(place) =
            usize::try_from(number - self.first).ok().filter(|place| !self.rows[*place].has_report)
        else {
            return;
        };
        let apart = |steps: u64| (self.period_ns / 8 * 7).saturating_mul(steps);
        let before = self.rows.range(..place).rev().zip(1..).find(|(row, _)| row.is_known());
        let after = self.rows.range(place + 1..).zip(1..).find(|(row, _)| row.sound);
        let Some(((last, since), (next, until))) = before.zip(after) else { return };
        let span = next.hsu_ns.saturating_sub(hsu_ns);
        if hsu_ns < last.hsu_ns.saturating_add(apart(since)) || span < apart(until) {
            return;
        }
        let (number, next_ns) = (number + until as i64, next.hsu_ns);
        self.rows[place] = Row { hsu_ns, agreed: true, ..self.rows[place] };
        self.spread(number, next_ns);
    }

    /// The time of a trigger; `None` also where reports contradict each other and the train has paused since the last
    /// sound one, for a time that is not known.
    pub fn time_ns(&self, number: i64) -> Option<u64> {
        self.row(number).filter(|_| self.is_calculable(number)).map(|row| row.hsu_ns)
    }

    fn is_calculable(&self, number: i64) -> bool {
        let Some(anchor) = self.anchor.filter(|anchor| anchor.contradicted) else { return true };
        !PAUSE_BEFORE.iter().any(|pause| (anchor.number + 1..=number).contains(pause))
    }

    /// The time of a trigger that the HSU itself reported, in rhythm.
    pub fn reported_ns(&self, number: i64) -> Option<u64> {
        self.row(number).filter(|row| row.sound).map(|row| row.hsu_ns)
    }

    fn row(&self, number: i64) -> Option<&Row> {
        self.rows.get(usize::try_from(number.checked_sub(self.first)?).ok()?)
    }

    /// The lowest number reported; 0 before the first.
    pub fn first(&self) -> i64 {
        self.first
    }

    /// One more than the highest number reported; 0 before the first.
    pub fn end(&self) -> i64 {
        if self.rows.is_empty() { 0 } else { self.first + self.rows.len() as i64 }
    }

    /// How many triggers of the session itself there are, warm-up not counted.
    pub fn len(&self) -> u64 {
        self.end().max(0) as u64
    }

    /// Whether nothing was reported yet.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// The time of the latest trigger.
    pub fn latest_ns(&self) -> Option<u64> {
        self.rows.back().map(|row| row.hsu_ns)
    }

    /// The trigger nearest in time, and how far `hsu_ns` lies after it.
    pub fn nearest(&self, hsu_ns: i128) -> Option<(i64, i128)> {
        let after = self.rows.partition_point(|row| i128::from(row.hsu_ns) < hsu_ns);
        let around = after.saturating_sub(1)..(after + 1).min(self.rows.len());
        let residual = |i: usize| (self.first + i as i64, hsu_ns - i128::from(self.rows[i].hsu_ns));
        let nearest = around.map(residual).min_by_key(|(_, residual)| residual.abs());
        nearest.filter(|(number, _)| self.is_calculable(*number))
    }
}

impl Anchor {
    fn at(number: i64, hsu_ns: u64, step_ns: f64) -> Self {
        Self { number, hsu_ns, step_ns, pause_ns: None, contradicted: false, late: false }
    }

    /// When a trigger `steps` triggers later is due, ns.
    fn expected_ns(&self, steps: i64) -> u64 {
        self.hsu_ns.saturating_add((self.step_ns * steps as f64) as u64)
    }
}

/// Triggers that were reported, and those that are due by now although their reports are held up.
#[derive(Debug, Clone, Copy)]
pub struct Schedule<'a> {
    table: &'a TriggerTable,
    /// How many triggers beyond the table are due, a period apart.
    due: i64,
    period_ns: u64,
}

impl TriggerTable {
    /// The triggers that were reported, without expected ones.
    pub fn reported(&self) -> Schedule<'_> {
        Schedule { table: self, due: 0, period_ns: 1 }
    }

    /// The same with the triggers that a train of this period has fired by `now_ns` (HSU clock), reported or not.
    pub fn expected_until(&self, now_ns: i128, period_ns: u64) -> Schedule<'_> {
        let since = self.latest_ns().map_or(0, |latest| now_ns - i128::from(latest));
        let due = (since / i128::from(period_ns.max(1))).clamp(0, HOLE_MAX.into()) as i64;
        Schedule { table: self, due, period_ns: period_ns.max(1) }
    }
}

impl Schedule<'_> {
    /// The time of a trigger.
    pub fn time_ns(&self, number: i64) -> Option<u64> {
        let ahead = number.checked_sub(self.table.end() - 1)?;
        if !(1..=self.due).contains(&ahead) {
            return self.table.time_ns(number);
        }
        self.table.latest_ns()?.checked_add(self.period_ns.checked_mul(ahead as u64)?)
    }

    /// Whether a trigger is known by expectation alone.
    pub fn is_expected(&self, number: i64) -> bool {
        number >= self.table.end()
    }

    /// The time of a trigger that the HSU itself reported, in rhythm.
    pub fn reported_ns(&self, number: i64) -> Option<u64> {
        self.table.reported_ns(number)
    }

    /// Whether a trigger's report is missing between others, and no two cameras agree on its time.
    pub fn is_bridged(&self, number: i64) -> bool {
        self.table.row(number).is_some_and(|row| !row.has_report && !row.agreed)
    }

    /// Whether the HSU itself gave a trigger's time.
    pub fn is_reported(&self, number: i64) -> bool {
        self.reported_ns(number).is_some()
    }

    /// One more than the number of the latest trigger.
    pub fn end(&self) -> i64 {
        self.table.end() + self.due
    }

    /// The time of the latest trigger.
    pub fn latest_ns(&self) -> Option<u64> {
        self.time_ns(self.table.end() - 1 + self.due)
    }

    /// The trigger nearest in time, and how far `hsu_ns` lies after it.
    pub fn nearest(&self, hsu_ns: i128) -> Option<(i64, i128)> {
        let ahead = hsu_ns - i128::from(self.table.latest_ns()?);
        if self.due == 0 || ahead <= 0 {
            return self.table.nearest(hsu_ns);
        }
        let period = i128::from(self.period_ns);
        let steps = ((ahead + period / 2) / period).min(self.due.into());
        Some((self.table.end() - 1 + steps as i64, ahead - steps * period))
    }
}

#[cfg(test)]
mod tests {
    use super::TriggerTable;

    impl TriggerTable {
        pub(crate) fn insert(&mut self, number: i64, hsu_ns: u64) {
            self.report(number, hsu_ns, true, true);
        }

        fn missing(&self) -> usize {
            self.rows.iter().filter(|row| !row.sound).count()
        }
    }

    #[test]
    fn triggers_are_expected_up_to_now_and_no_further() {
        let mut table = TriggerTable::default();
        assert!(table.expected_until(5_000, 100).nearest(4_000).is_none(), "nothing to count from");
        table.insert(7, 1_000);
        let schedule = table.expected_until(1_350, 100);
        assert_eq!(
            [7, 8, 10, 11, 6].map(|n| schedule.time_ns(n)),
            [Some(1_000), Some(1_100), Some(1_300), None, None]
        );
        assert_eq!(schedule.latest_ns(), Some(1_300));
        assert_eq!(
            [990, 1_149, 1_151, 1_390].map(|t| schedule.nearest(t)),
            [(7, -10), (8, 49), (9, -49), (10, 90)].map(Some)
        );
        let reported = table.reported();
        assert_eq!(
            (reported.time_ns(8), reported.nearest(1_149), reported.latest_ns()),
            (None, Some((7, 149)), Some(1_000))
        );
        assert_eq!(table.expected_until(i128::MAX, 0).nearest(1_100), Some((107, 0)));
    }

    #[test]
    fn what_cameras_agree_on_stands_until_the_report_is_there() {
        let mut table = TriggerTable::default();
        table.infer(3, 1_000);
        assert!(table.is_empty(), "nothing to count from");
        table.insert(4, 1_100);
        table.infer(4, 1_500);
        table.infer(6, 1_310);
        assert_eq!((table.time_ns(4), table.time_ns(6), table.end()), (Some(1_100), Some(1_310), 7));
        let reported = |table: &TriggerTable| [3, 4, 5, 6, 7].map(|n| table.reported().is_reported(n));
        assert_eq!((reported(&table), table.missing()), ([false, true, false, false, false], 2));
        table.insert(6, 1_300);
        assert_eq!((table.time_ns(6), reported(&table)[3]), (Some(1_300), true));
    }

    #[test]
    fn between_reports_cameras_may_agree_on_what_the_train_allows() {
        let mut table = TriggerTable::new(1_000);
        [(0, 1_000), (5, 6_600)].into_iter().for_each(|(number, ns)| table.insert(number, ns));
        let times = |table: &TriggerTable| [1, 2, 3, 4].map(|number| table.time_ns(number));
        assert_eq!(times(&table), [2_120, 3_240, 4_360, 5_480].map(Some), "evenly, until more is known");
        table.infer(1, 2_600);
        assert_eq!(times(&table), [2_600, 3_600, 4_600, 5_600].map(Some), "the first of them was late");
        for (number, ns) in [(2, 3_300), (2, 4_100), (0, 1_400)] {
            table.infer(number, ns);
            assert_eq!(
                table.time_ns(2),
                Some(3_600),
                "closer than 7/8 of a period, or reported: {number} {ns}"
            );
        }
        assert_eq!(table.missing(), 4);
        table.insert(1, 2_590);
        assert!(table.has_report(1) && table.time_ns(1) == Some(2_590));
    }

    #[test]
    fn a_report_behind_a_hole_leaves_what_cameras_agreed_on() {
        let mut table = TriggerTable::new(1_000);
        table.insert(0, 1_000);
        [(1, 2_000), (2, 3_000)].into_iter().for_each(|(number, ns)| table.infer(number, ns));
        table.insert(5, 8_000);
        let times = [1, 2, 3, 4].map(|number| table.time_ns(number));
        assert_eq!(times, [2_000, 3_000, 4_666, 6_333].map(Some), "trigger 3, 4 or 5 was late");
        table.infer(3, 4_000);
        assert_eq!(table.time_ns(3), Some(4_000));
    }

    #[test]
    fn missing_reports_are_bridged_and_late_ones_taken() {
        let mut table = TriggerTable::default();
        table.insert(-2, 1_000);
        table.insert(2, 5_000);
        assert_eq!((table.missing(), table.len(), table.end()), (3, 3, 3));
        assert_eq!(table.time_ns(0), Some(3_000));
        table.insert(0, 3_100);
        assert_eq!((table.missing(), table.time_ns(0)), (2, Some(3_100)));
        assert_eq!(table.nearest(3_300), Some((0, 200)));
        assert_eq!(table.nearest(-50), Some((-2, -1_050)));
        assert_eq!(table.nearest(9_000), Some((2, 4_000)));
    }

    #[test]
    fn what_cannot_be_is_ignored() {
        let mut table = TriggerTable::default();
        table.insert(0, 1_000);
        table.insert(1, 900);
        table.insert(i64::MAX, 5_000);
        table.insert(i64::MIN, 5_000);
        table.insert(5_000_000, 6_000);
        assert_eq!((table.reported_ns(0), table.reported_ns(1), table.end()), (Some(1_000), None, 2));
    }
}
