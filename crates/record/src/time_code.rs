// SPDX-License-Identifier: MIT OR Apache-2.0
//! Time code in a recording: events, whose message is JSON, and what code it was at a time of the HSU's clock.
//!
//! A **run** is a row of codes each of which follows the one before, with no time between them. Of a run its first code
//! is recorded, one a second, and its last. Between two of them the others are counted, and a fraction of a frame is by
//! time.

use super::layout::NodeEvent;
use hsu_firmware_proto::TimeCode;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error};
use std::collections::BTreeMap;
use std::fmt;

/// A code as the HSU received it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct HeardTimeCode {
    /// Consecutive since the HSU was switched on.
    pub number: u64,
    /// Number of its run in this recording, from 0.
    pub run: u64,
    /// The code that the line carried.
    #[serde(serialize_with = "write_code", deserialize_with = "read_code")]
    pub code: TimeCode,
    /// The edge that its first bit begins with, HSU clock, ns.
    pub hsu_time_ns: u64,
    /// From there to the next frame's first edge, ns.
    pub duration_ns: u32,
}

/// Kind of the events that hold a [`HeardTimeCode`].
const KIND: &str = "time_code";

impl HeardTimeCode {
    /// The event that records it; `host_time_ns` is when the node received it.
    pub fn event(&self, host_time_ns: u64) -> NodeEvent {
        NodeEvent::of_json(KIND, host_time_ns, self)
    }

    /// The code that an event holds; `None` for other kinds.
    pub fn of(event: &NodeEvent) -> Option<Self> {
        event.json(KIND)
    }

    /// Whether this is the next frame after `before`: it begins where that one ended, and its code is the next one.
    pub fn follows(&self, before: &Self) -> bool {
        self.hsu_time_ns == before.hsu_time_ns.saturating_add(u64::from(before.duration_ns))
            && before.code.is_followed_by(self.code)
    }
}

fn write_code<S: Serializer>(code: &TimeCode, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(code)
}

fn read_code<'de, D: Deserializer<'de>>(deserializer: D) -> Result<TimeCode, D::Error> {
    let text = String::deserialize(deserializer)?;
    TimeCode::parse(&text).ok_or_else(|| D::Error::custom("expected HH:MM:SS:FF"))
}

/// A code, and how much of its frame had gone by.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimeCodeAt {
    pub code: TimeCode,
    /// Share of the code's frame that had passed, 0 to 1.
    pub fraction: f64,
}

/// As `HH:MM:SS:FF.fff`; thousandths are cut, so that they are never those of the next frame.
impl fmt::Display for TimeCodeAt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let thousandths = (self.fraction * 1000.0) as u32;
        write!(f, "{}.{:03}", self.code, thousandths.min(999))
    }
}

/// The time code of one recording.
#[derive(Debug, Clone, Default)]
pub struct TimeCodeLine {
    heard: BTreeMap<u64, HeardTimeCode>,
}

impl TimeCodeLine {
    /// The time code in the events of a recording.
    pub fn of(events: &[NodeEvent]) -> Self {
        let heard = events.iter().filter_map(HeardTimeCode::of);
        Self { heard: heard.map(|heard| (heard.hsu_time_ns, heard)).collect() }
    }

    /// The recorded codes, in order of time.
    pub fn heard(&self) -> impl DoubleEndedIterator<Item = &HeardTimeCode> {
        self.heard.values()
    }

    /// The code at a time of the HSU's clock; `None` before, between and after runs, and where what was recorded before
    /// and after does not add up.
    pub fn at(&self, hsu_time_ns: u64) -> Option<TimeCodeAt> {
        let (_, before) = self.heard.range(..=hsu_time_ns).next_back()?;
        let gone_ns = (hsu_time_ns - before.hsu_time_ns) as f64;
        let after = self.heard.range(hsu_time_ns.checked_add(1)?..).next().map(|(_, after)| after);
        let Some(after) = after.filter(|after| after.run == before.run) else {
            let fraction = gone_ns / f64::from(before.duration_ns);
            return (fraction < 1.0).then_some(TimeCodeAt { code: before.code, fraction });
        };
        let frames = u32::try_from(after.number.checked_sub(before.number)?).ok()?;
        let per_second = TimeCode::RATES
            .into_iter()
            .find(|&per_second| before.code.until(after.code, per_second) == Some(frames))?;
        let place = gone_ns / (after.hsu_time_ns - before.hsu_time_ns) as f64 * f64::from(frames);
        let code = before.code.after(place as u32, per_second)?;
        Some(TimeCodeAt { code, fraction: place.fract() })
    }
}

#[cfg(test)]
mod tests {
    use super::{HeardTimeCode, TimeCodeLine};
    use hsu_firmware_proto::TimeCode;

    fn heard(number: u64, run: u64, code: &str, hsu_time_ns: u64) -> HeardTimeCode {
        let code = TimeCode::parse(code).expect("a code");
        HeardTimeCode { number, run, code, hsu_time_ns, duration_ns: 40_000_000 }
    }

    fn shown(line: &TimeCodeLine, hsu_time_ns: u64) -> String {
        line.at(hsu_time_ns).map_or_else(String::new, |at| at.to_string())
    }

    #[test]
    fn codes_between_two_that_were_recorded_are_counted() {
        let second = 1_000_000_000;
        let codes = [
            heard(10, 0, "10:00:00:20", second),
            heard(35, 0, "10:00:01:20", 2 * second),
            heard(36, 1, "22:59:59:24", 3 * second),
            heard(61, 1, "23:00:00:24", 4 * second),
        ];
        let events: Vec<_> = codes.iter().map(|code| code.event(7)).collect();
        let line = TimeCodeLine::of(&events);
        assert_eq!(line.heard().copied().collect::<Vec<_>>(), codes);
        for (at, expected) in [
            (second - 1, ""),
            (second, "10:00:00:20.000"),
            (second + 10_000_000, "10:00:00:20.250"),
            (second + 199_999_999, "10:00:00:24.999"),
            (second + 200_000_000, "10:00:01:00.000"),
            (2 * second - 1, "10:00:01:19.999"),
            (2 * second + 39_000_000, "10:00:01:20.975"),
            (2 * second + 40_000_000, ""),
            (3 * second - 1, ""),
            (3 * second + 60_000_000, "23:00:00:00.500"),
            (4 * second + 39_999_999, "23:00:00:24.999"),
            (5 * second, ""),
            (u64::MAX, ""),
        ] {
            assert_eq!(shown(&line, at), expected, "{at}");
        }
    }

    #[test]
    fn what_does_not_add_up_is_no_time_code() {
        let second = 1_000_000_000;
        // 26 frames in what is a second at 24, 25 and 30; and a number that goes back.
        for number in [36, 9] {
            let codes = [heard(10, 0, "10:00:00:20", second), heard(number, 0, "10:00:01:20", 2 * second)];
            let line = TimeCodeLine::of(&codes.map(|code| code.event(7)));
            assert_eq!(shown(&line, second + 1), "", "{number}");
        }
        let mut damaged = heard(0, 0, "10:00:00:20", 0).event(7);
        damaged.message = damaged.message.replace("10:00:00:20", "10:00:00:99");
        assert_eq!(TimeCodeLine::of(&[damaged]).heard().count(), 0);
    }

    #[test]
    fn a_frame_follows_where_the_one_before_ended() {
        let before = heard(10, 0, "10:00:00:24", 1000);
        for (code, hsu_time_ns, expected) in [
            ("10:00:01:00", 40_001_000, true),
            ("10:00:01:00", 40_001_001, false),
            ("10:00:01:01", 40_001_000, false),
            ("10:00:00:25", 40_001_000, true),
        ] {
            assert_eq!(heard(11, 0, code, hsu_time_ns).follows(&before), expected, "{code} {hsu_time_ns}");
        }
    }
}
