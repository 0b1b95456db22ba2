// SPDX-License-Identifier: MIT OR Apache-2.0
//! When a sensor accepts a trigger: the timing of a global shutter with overlapped readout, nothing else.
//!
//! A new exposure may begin once the last one has ended, and may only end once the last readout has ended.
//! A trigger that asks for anything else is ignored, as by a real camera: no frame, no block id.

use std::time::{Duration, Instant};

/// Time to read one row out: 1200 rows in 6.13 ms, the 163 Hz of a free-running 1920 x 1200 camera.
const ROW_READOUT: Duration = Duration::from_nanos(5_110);

/// Time to read an image of a number of rows out.
pub fn readout(rows: u32) -> Duration {
    ROW_READOUT.saturating_mul(rows)
}

/// The shortest period between exposures of this length.
pub fn shortest_period(exposure: Duration, rows: u32) -> Duration {
    exposure.max(readout(rows))
}

/// An exposure that the sensor has accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Exposure {
    pub start: Instant,
    /// The shutter closes, and readout and transmission begin.
    pub end: Instant,
}

/// What the sensor is still busy with.
#[derive(Debug, Default)]
pub struct Sensor {
    exposure_end: Option<Instant>,
    readout_end: Option<Instant>,
    last: Option<Instant>,
    /// An exposure begins only when the last readout has ended.
    pub apart: bool,
    /// Shortest time between the starts of two exposures, where it is paced.
    pub pace: Option<Duration>,
    /// From the end of an exposure to the start of its readout.
    before_readout: Duration,
}

impl Sensor {
    /// A sensor that begins its readout this time after an exposure.
    pub fn new(before_readout: Duration) -> Self {
        Self { before_readout, ..Self::default() }
    }

    /// Exposes on a trigger at `time`, or ignores it (`None`) where the sensor is busy.
    pub fn trigger(&mut self, time: Instant, exposure: Duration, rows: u32) -> Option<Exposure> {
        let end = time.checked_add(exposure)?;
        let exposing = self.exposure_end.is_some_and(|busy| time < busy);
        let reading = self.readout_end.is_some_and(|busy| end < busy);
        let read_first = self.apart && self.readout_end.is_some_and(|busy| time < busy);
        let too_soon = self.pace.zip(self.last).is_some_and(|(pace, last)| time < last + pace);
        if exposing || reading || read_first || too_soon {
            return None;
        }
        self.last = Some(time);
        self.exposure_end = Some(end);
        self.readout_end = end.checked_add(self.before_readout + readout(rows));
        Some(Exposure { start: time, end })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn exposures_longer_than_the_period_cost_triggers() {
        let start = Instant::now();
        let accepted = |exposure_us| {
            let mut sensor = Sensor::default();
            let times = (0..120).map(|k| start + Duration::from_nanos(k * 8_333_333));
            times.filter(|t| sensor.trigger(*t, Duration::from_micros(exposure_us), 1200).is_some()).count()
        };
        assert_eq!(accepted(3000), 120);
        assert_eq!(accepted(8300), 120);
        assert_eq!(accepted(8400), 60, "every second trigger falls into an exposure");
        assert_eq!(accepted(17_000), 40);
    }

    #[test]
    fn triggers_faster_than_the_readout_are_ignored() {
        let (start, mut sensor) = (Instant::now(), Sensor::default());
        let times = (0..200).map(|k| start + Duration::from_millis(5 * k));
        let accepted = times.filter(|t| sensor.trigger(*t, Duration::from_millis(1), 1200).is_some());
        assert_eq!(accepted.count(), 100, "6.13 ms of readout do not fit into 5 ms");
    }

    proptest! {
        #[test]
        fn accepted_exposures_never_overlap(
            gaps in proptest::collection::vec(0u64..20_000, 1..50), exposure_us in 1u64..20_000, rows in 1u32..1200,
        ) {
            let (mut time, mut sensor, mut last) = (Instant::now(), Sensor::default(), None::<Exposure>);
            let exposure = Duration::from_micros(exposure_us);
            for gap in gaps {
                time += Duration::from_micros(gap);
                let Some(now) = sensor.trigger(time, exposure, rows) else { continue };
                if let Some(last) = last {
                    prop_assert!(now.start >= last.end);
                    prop_assert!(now.end >= last.end + readout(rows), "readouts do not overlap");
                }
                last = Some(now);
            }
        }
    }
}
