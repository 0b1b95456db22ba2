// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reads during a session the time codes that the HSU received, and makes events of those that are worth recording:
//! the first of each run, one a second, and the last.

use super::event_kind::EventKind;
use crate::hsu::{HeardTimeCodes, Hsu, HsuError, Refusal, TIME_CODE_HISTORY};
use crate::record::{HeardTimeCode, NodeEvent};
use std::time::Duration;

/// Time after which a running code is recorded again: one event a second is enough to interpolate.
const INTERVAL_NS: u64 = 1_000_000_000;
/// Time that the end of a session waits for the code frame under way: the longest lasts 44 ms.
pub const LAST_FRAME: Duration = Duration::from_millis(60);

/// The requests for time code that a unit answers.
pub trait TimeCodeUnit {
    /// Sends the unit the input that carries the code.
    fn name_input(&self, input: u8) -> Result<(), HsuError>;
    /// Requests codes from a number on.
    fn codes(&self, first: u64) -> Result<HeardTimeCodes, HsuError>;
}

impl TimeCodeUnit for Hsu {
    fn name_input(&self, input: u8) -> Result<(), HsuError> {
        self.set_time_code(Some(input))
    }

    fn codes(&self, first: u64) -> Result<HeardTimeCodes, HsuError> {
        self.time_codes(first)
    }
}

/// The time codes of a session so far, and what of them is recorded.
#[derive(Debug, Default)]
pub struct TimeCodeKeeper {
    /// The input; `None`: no time code is configured.
    input: Option<u8>,
    /// The unit knows the input since the last connection.
    named: bool,
    /// Number of the next code; `None` before the first answer.
    next: Option<u64>,
    /// Counters of unreadable code frames, at the first answer and at the last.
    refused: Option<(u32, u32)>,
    last: Option<HeardTimeCode>,
    /// A code arrived at the last look.
    is_running: bool,
    /// The last code is in the recording.
    is_recorded: bool,
    /// When the last one that was recorded began, HSU clock.
    recorded_ns: u64,
    runs: u64,
    /// Why the unit gives none, where there was to be some.
    why_none: Option<String>,
}

impl TimeCodeKeeper {
    /// For this input of the HSU.
    pub fn new(input: Option<u8>) -> Self {
        Self { input, ..Self::default() }
    }

    /// The unit was connected anew: it has to receive the input again.
    pub fn reconnected(&mut self) {
        self.named = false;
    }

    /// Whether code came at the last look, so that a frame may be on its way.
    pub fn is_running(&self) -> bool {
        self.is_running
    }

    /// The events since the last call; none where the unit does not answer, and the next call repeats the request.
    /// `host_time_ns` is now.
    pub fn look(&mut self, unit: &impl TimeCodeUnit, host_time_ns: u64) -> Vec<NodeEvent> {
        let mut events = Vec::new();
        let before = self.next;
        if let Err(error) = self.ask(unit, host_time_ns, &mut events) {
            tracing::debug!("the HSU's time code: {error}");
            if matches!(error, HsuError::Refused { refusal: Refusal::UnknownRequest { .. }, .. }) {
                let message = "the HSU's firmware does not know time code: it needs a newer one";
                self.give_up(message.to_owned(), host_time_ns, &mut events);
            } else if let HsuError::Refused { refusal: Refusal::TimeCodeDiffers { .. }, .. } = &error {
                self.give_up(error.to_string(), host_time_ns, &mut events);
            }
        }
        self.is_running = before.is_some() && self.next != before;
        if !self.is_running {
            // It has stopped, for all that is known.
            self.record_last(host_time_ns, &mut events);
        }
        events
    }

    /// Ends the watch with the session: the last code, and what was missing.
    pub fn finish(&mut self, host_time_ns: u64) -> Vec<NodeEvent> {
        let mut events = Vec::new();
        self.record_last(host_time_ns, &mut events);
        let Some(input) = self.input else { return events };
        let refused = self.no_good();
        if let Some(message) = self.absence(false) {
            events.push(EventKind::TimeCodeAbsent.event(host_time_ns, None, message));
        } else if refused > 0 {
            let message = format!("{refused} frames of time code on input {input} were no good");
            events.push(EventKind::TimeCodeRefused.event(host_time_ns, None, message));
        }
        events
    }

    /// That no code was understood, where there was to be one; `so_far`: with what to check while the session runs.
    pub fn absence(&self, so_far: bool) -> Option<String> {
        if self.why_none.is_some() {
            return self.why_none.clone();
        }
        let input = self.input.filter(|_| self.runs == 0)?;
        Some(match (so_far, self.no_good()) {
            (false, 0) => format!("no time code came on input {input}"),
            (false, refused) => {
                format!("no time code was understood on input {input}: {refused} frames were no good")
            }
            (true, 0) => format!(
                "no time code is understood on input {input} so far: none comes: is it played, and wired to this input \
                 (hsu.time_code_input)?"
            ),
            (true, _) => format!(
                "no time code is understood on input {input} so far: frames come and are no good: check level, ground \
                 and adapter of the line"
            ),
        })
    }

    /// Number of unreadable code frames since the first answer.
    fn no_good(&self) -> u32 {
        let (first, last) = self.refused.unwrap_or_default();
        last.saturating_sub(first)
    }

    fn give_up(&mut self, why: String, host_time_ns: u64, events: &mut Vec<NodeEvent>) {
        events.push(EventKind::TimeCodeAbsent.event(host_time_ns, None, why.clone()));
        (self.input, self.why_none) = (None, Some(why));
    }

    fn ask(
        &mut self,
        unit: &impl TimeCodeUnit,
        host_time_ns: u64,
        events: &mut Vec<NodeEvent>,
    ) -> Result<(), HsuError> {
        let Some(input) = self.input else { return Ok(()) };
        if !self.named {
            unit.name_input(input)?;
            self.named = true;
        }
        // Each answer has one code at least, or it is the last.
        for _ in 0..TIME_CODE_HISTORY {
            let answer = unit.codes(self.next.unwrap_or(u64::MAX))?;
            if answer.input != Some(input) {
                // It was restarted.
                self.named = false;
                return Ok(());
            }
            let begin = self.refused.filter(|(_, last)| *last <= answer.refused).map(|(first, _)| first);
            self.refused = Some((begin.unwrap_or(answer.refused), answer.refused));
            let Some(asked) = self.next else {
                self.next = Some(answer.next);
                return Ok(());
            };
            if answer.next < asked {
                let message =
                    "the HSU counts time codes anew: it was restarted, and what came before is lost";
                events.push(EventKind::TimeCodeLost.event(host_time_ns, None, message));
                self.next = Some(0);
                continue;
            }
            if answer.first > asked && !answer.codes.as_slice().is_empty() {
                let message = format!("{} time codes came and were forgotten", answer.first - asked);
                events.push(EventKind::TimeCodeLost.event(host_time_ns, None, message));
            }
            let mut next = asked;
            for (number, frame) in (answer.first..u64::MAX).zip(answer.codes.as_slice()) {
                if number < next {
                    continue;
                }
                next = number.saturating_add(1);
                let heard = HeardTimeCode {
                    number,
                    run: 0,
                    code: frame.code,
                    hsu_time_ns: frame.time_ns,
                    duration_ns: frame.duration_ns,
                };
                self.take(heard, host_time_ns, events);
            }
            self.next = Some(next);
            if next == asked || next >= answer.next {
                break;
            }
        }
        Ok(())
    }

    fn take(&mut self, heard: HeardTimeCode, host_time_ns: u64, events: &mut Vec<NodeEvent>) {
        let goes_on = self.last.is_some_and(|last| last.number + 1 == heard.number && heard.follows(&last));
        if !goes_on {
            self.record_last(host_time_ns, events);
            self.runs += 1;
        }
        self.last = Some(HeardTimeCode { run: self.runs - 1, ..heard });
        self.is_recorded = false;
        if !goes_on || heard.hsu_time_ns.saturating_sub(self.recorded_ns) >= INTERVAL_NS {
            self.record_last(host_time_ns, events);
        }
    }

    fn record_last(&mut self, host_time_ns: u64, events: &mut Vec<NodeEvent>) {
        let Some(last) = self.last.filter(|_| !self.is_recorded) else { return };
        events.push(last.event(host_time_ns));
        (self.is_recorded, self.recorded_ns) = (true, last.hsu_time_ns);
    }
}

#[cfg(test)]
mod tests {
    use super::{TimeCodeKeeper, TimeCodeUnit};
    use crate::hsu::{
        HeardTimeCodes, HsuError, Refusal, TIME_CODE_HISTORY, TimeCode, TimeCodeFrame, TimeCodeFrames,
    };
    use crate::record::{HeardTimeCode, NodeEvent, TimeCodeLine};
    use std::cell::{Cell, RefCell};

    const FRAME_NS: u64 = 40_000_000;

    /// A unit that received these codes.
    #[derive(Default)]
    struct Unit {
        heard: RefCell<Vec<TimeCodeFrame>>,
        named: Cell<Option<u8>>,
        refused: Cell<u32>,
        refusal: Cell<Option<Refusal>>,
        asked: Cell<usize>,
    }

    impl Unit {
        /// Codes at 25 frames a second; the last of them, and when it ends.
        fn hears(&self, code: &str, from_ns: u64, count: u32) -> (TimeCode, u64) {
            let first = TimeCode::parse(code).expect("a code");
            for at in 0..count {
                let time_ns = from_ns + u64::from(at) * FRAME_NS;
                let code = first.after(at, 25).expect("a code");
                self.heard.borrow_mut().push(TimeCodeFrame { time_ns, duration_ns: FRAME_NS as u32, code });
            }
            (first.after(count - 1, 25).expect("a code"), from_ns + u64::from(count) * FRAME_NS)
        }
    }

    fn refused(refusal: Refusal) -> HsuError {
        HsuError::Refused { request: "a question for time code", refusal }
    }

    impl TimeCodeUnit for Unit {
        fn name_input(&self, input: u8) -> Result<(), HsuError> {
            self.named.set(Some(input));
            self.refusal.get().map_or(Ok(()), |refusal| Err(refused(refusal)))
        }

        fn codes(&self, first: u64) -> Result<HeardTimeCodes, HsuError> {
            self.asked.set(self.asked.get() + 1);
            let heard = self.heard.borrow();
            let next = heard.len() as u64;
            let first = first.clamp(next.saturating_sub(TIME_CODE_HISTORY as u64), next);
            let mut codes = TimeCodeFrames::default();
            heard[first as usize..].iter().all(|frame| codes.push(*frame));
            Ok(HeardTimeCodes { input: self.named.get(), next, refused: self.refused.get(), first, codes })
        }
    }

    fn kinds(events: &[NodeEvent]) -> Vec<&str> {
        events.iter().map(|event| event.kind.as_str()).collect()
    }

    /// Code of ten minutes, read five times a second: two events more than seconds.
    #[test]
    fn of_a_run_the_first_code_is_recorded_one_a_second_and_the_last() {
        let (unit, mut keeper, mut events) = (Unit::default(), TimeCodeKeeper::new(Some(3)), Vec::new());
        assert!(keeper.look(&unit, 0).is_empty() && !keeper.is_running());
        let (mut code, mut at_ns) = (TimeCode::parse("09:59:59:20").expect("a code"), 5);
        let (first, begin_ns) = (code, at_ns);
        assert!(keeper.absence(true).is_some_and(|text| text.contains("input 3 so far: none comes")));
        for _ in 0..3000 {
            let (last, end_ns) = unit.hears(&code.to_string(), at_ns, 5);
            (code, at_ns) = (last.after(1, 25).expect("a code"), end_ns);
            events.extend(keeper.look(&unit, 0));
            assert!(keeper.is_running());
        }
        events.extend(keeper.finish(0));
        assert_eq!((keeper.absence(false), keeper.absence(true)), (None, None));
        let heard: Vec<HeardTimeCode> = events.iter().filter_map(HeardTimeCode::of).collect();
        assert_eq!((heard.len(), events.len()), (601, 601));
        assert!(heard.iter().all(|heard| heard.run == 0));
        // All codes in between are known.
        let line = TimeCodeLine::of(&events);
        for frame in (0..15_000).step_by(37) {
            let at = line.at(begin_ns + u64::from(frame) * FRAME_NS + FRAME_NS / 2).expect("a code");
            assert_eq!((Some(at.code), (at.fraction * 2.0).round()), (first.after(frame, 25), 1.0));
        }
        assert_eq!((line.at(begin_ns - 1), line.at(at_ns)), (None, None));
    }

    #[test]
    fn code_that_begins_late_jumps_pauses_and_stops_is_recorded_as_it_was() {
        let (unit, mut keeper, mut events) = (Unit::default(), TimeCodeKeeper::new(Some(3)), Vec::new());
        for _ in 0..4 {
            events.extend(keeper.look(&unit, 0));
        }
        assert!(events.is_empty());
        let (_, end_ns) = unit.hears("10:00:00:00", 1000, 8);
        let (_, end_ns) = unit.hears("20:00:00:00", end_ns, 5);
        events.extend(keeper.look(&unit, 0));
        // A frame that was no good lies between; and then nothing more.
        let (_, end_ns) = unit.hears("20:00:00:06", end_ns + FRAME_NS, 3);
        unit.refused.set(1);
        events.extend(keeper.look(&unit, 0));
        events.extend(keeper.look(&unit, 0));
        events.extend(keeper.finish(0));
        let heard: Vec<(u64, String)> = events
            .iter()
            .filter_map(HeardTimeCode::of)
            .map(|heard| (heard.run, heard.code.to_string()))
            .collect();
        let expected = [
            (0, "10:00:00:00"),
            (0, "10:00:00:07"),
            (1, "20:00:00:00"),
            (1, "20:00:00:04"),
            (2, "20:00:00:06"),
            (2, "20:00:00:08"),
        ];
        assert_eq!(heard, expected.map(|(run, code)| (run, code.to_owned())));
        assert_eq!(kinds(&events)[6..], ["time_code_refused"]);
        let line = TimeCodeLine::of(&events);
        let shown = |at_ns: u64| line.at(at_ns).map(|at| at.to_string());
        assert_eq!(shown(1000 + 8 * FRAME_NS - 1).as_deref(), Some("10:00:00:07.999"));
        assert_eq!(shown(1000 + 8 * FRAME_NS).as_deref(), Some("20:00:00:00.000"));
        assert_eq!(shown(1000 + 13 * FRAME_NS), None, "the frame that was no good");
        assert_eq!(shown(end_ns), None);
    }

    #[test]
    fn what_is_lost_or_absent_is_told() {
        let (unit, mut keeper) = (Unit::default(), TimeCodeKeeper::new(Some(3)));
        unit.refused.set(7);
        keeper.look(&unit, 0);
        unit.refused.set(9);
        keeper.look(&unit, 0);
        let so_far = keeper.absence(true).expect("none was understood");
        assert!(so_far.contains("input 3 so far: frames come and are no good"), "{so_far}");
        let events = keeper.finish(0);
        assert_eq!(kinds(&events), ["time_code_absent"]);
        assert!(events[0].message.contains("input 3: 2 frames"), "{}", events[0].message);
        assert_eq!(keeper.absence(false).as_ref(), Some(&events[0].message));

        // More than the unit remembers, and then it is switched off and on.
        let (unit, mut keeper) = (Unit::default(), TimeCodeKeeper::new(Some(3)));
        keeper.look(&unit, 0);
        let remembered = TIME_CODE_HISTORY as u32;
        unit.hears("10:00:00:00", 0, remembered + 9);
        let events = keeper.look(&unit, 0);
        assert_eq!(kinds(&events)[0], "time_code_lost");
        assert!(events[0].message.starts_with("9 time codes"), "{}", events[0].message);
        unit.heard.borrow_mut().clear();
        unit.named.set(None);
        assert_eq!(kinds(&keeper.look(&unit, 0)), ["time_code"], "the last one");
        unit.hears("11:00:00:00", 9, 2);
        let events = keeper.look(&unit, 0);
        assert_eq!((unit.named.get(), kinds(&events)), (Some(3), vec!["time_code_lost", "time_code"]));

        let (unit, mut keeper) = (Unit::default(), TimeCodeKeeper::new(None));
        assert!(keeper.look(&unit, 0).is_empty() && keeper.finish(0).is_empty());
        assert_eq!((unit.asked.get(), unit.named.get()), (0, None));
    }

    #[test]
    fn a_unit_without_time_code_and_one_that_listens_elsewhere_are_told_once() {
        for refusal in [Refusal::UnknownRequest { kind: 14 }, Refusal::TimeCodeDiffers { unit: 4, host: 3 }] {
            let (unit, mut keeper) = (Unit::default(), TimeCodeKeeper::new(Some(3)));
            unit.refusal.set(Some(refusal));
            let events = keeper.look(&unit, 0);
            assert_eq!(kinds(&events), ["time_code_absent"]);
            assert!(keeper.look(&unit, 0).is_empty() && keeper.finish(0).is_empty());
            assert_eq!(keeper.absence(false).as_ref(), Some(&events[0].message));
            assert_eq!(keeper.absence(true), keeper.absence(false));
            assert_eq!(unit.asked.get(), 0);
        }
        // The request is repeated after any other refusal.
        let (unit, mut keeper) = (Unit::default(), TimeCodeKeeper::new(Some(3)));
        unit.refusal.set(Some(Refusal::HelloFirst));
        assert!(keeper.look(&unit, 0).is_empty());
        unit.refusal.set(None);
        keeper.look(&unit, 0);
        assert_eq!(unit.asked.get(), 1);
    }
}
