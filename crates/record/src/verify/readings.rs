// SPDX-License-Identifier: MIT OR Apache-2.0
//! A device's clock against the host's, from the recorded readings alone.
//!
//! A reading shows that the clock had a value at some time between request and answer. Near it this bounds host time
//! from both sides, and clocks differ in rate by a known share at most. So each time is looked up among the readings
//! around it, in an hour's recording as in a second's: no line is drawn through all of them. Where the clock was set, a
//! new **epoch** begins.

use crate::layout::ClockSample;

/// Most epochs of a clock: one that was set more often is no evidence, and its later readings are not used.
const EPOCHS: usize = 1000;
/// Most epochs that may be in force at an instant: it bounds what looking up a time costs.
const IN_FORCE: usize = 16;
/// Time before its first and behind its last reading for which an epoch is in force, ns.
const BETWEEN_READINGS_NS: i128 = 5_000_000_000;
/// Readings on each side of a time that are used for it: more than are made at once.
const AROUND: usize = 20;
/// Reciprocal of the largest relative difference of two clocks' rates: crystals differ by 100 ppm, a slewed host by
/// 500.
const RATE: i128 = 2_000;
/// Difference allowed between readings that follow each other, beyond their round trips, ns.
const SLACK_NS: i128 = 100_000;
/// Reciprocal of the relative difference allowed between them in addition.
const STEP_RATE: i128 = 1_000;
/// Readings that must agree with each other to show that a clock was set; fewer may be wrong themselves.
const SUSTAINED: usize = 3;

/// One reading of the device's clock, ns.
#[derive(Debug, Clone, Copy)]
struct Reading {
    sent: i128,
    received: i128,
    device: i128,
}

impl Reading {
    fn of(sample: &ClockSample) -> Self {
        Self {
            sent: sample.host_send_ns.into(),
            received: sample.host_receive_ns.into(),
            device: sample.device_time_ns.into(),
        }
    }

    /// How much further than the host's clock this one went, beyond what two readings leave open, ns.
    fn jump_to(&self, next: &Self) -> i128 {
        let host = (next.sent + next.received - self.sent - self.received) / 2;
        let device = next.device - self.device;
        let open = (self.received - self.sent + next.received - next.sent) / 2;
        let allowed = open + SLACK_NS + host.abs() / STEP_RATE;
        let jump = device - host;
        jump.signum() * (jump.abs() - allowed).max(0)
    }
}

/// A clock between two settings.
#[derive(Debug)]
pub struct Epoch {
    readings: Vec<Reading>,
}

/// The host's time of a device's time, and half of what the readings leave open, ns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HostTime {
    /// Middle of what the readings leave open, host clock, ns.
    pub ns: i128,
    pub open_ns: i128,
}

impl Epoch {
    /// The host's time at which the device showed this; `None` where the clock was seen at one reading only, and may
    /// stand still.
    pub fn host_time(&self, device_ns: i128) -> Option<HostTime> {
        let (first, last) = self.readings.first().zip(self.readings.last())?;
        if first.device == last.device {
            return None;
        }
        let place = self.readings.partition_point(|reading| reading.device < device_ns);
        let around = &self.readings[place.saturating_sub(AROUND)..(place + AROUND).min(self.readings.len())];
        let (mut least, mut most) = (i128::MIN, i128::MAX);
        for reading in around {
            let drift = (device_ns - reading.device).abs() / RATE;
            least = least.max(reading.sent - reading.device - drift);
            most = most.min(reading.received - reading.device + drift);
        }
        let open_ns = (most - least).abs() / 2;
        Some(HostTime { ns: device_ns + (least + most).div_euclid(2), open_ns })
    }

    /// Whether it may be in force at a time of the host.
    fn covers(&self, host_ns: i128) -> bool {
        let ends = self.readings.first().zip(self.readings.last());
        ends.is_some_and(|(first, last)| {
            host_ns + BETWEEN_READINGS_NS >= first.sent && host_ns <= last.received + BETWEEN_READINGS_NS
        })
    }

    /// The host's time of its first reading, ns.
    pub fn begin_ns(&self) -> i128 {
        self.readings.first().map_or(0, |reading| reading.sent)
    }

    /// Whether enough readings agree with each other.
    pub fn is_sustained(&self) -> bool {
        self.readings.len() >= SUSTAINED
    }
}

/// All readings of one device's clock.
#[derive(Debug, Default)]
pub struct Readings {
    /// In the order of time.
    pub epochs: Vec<Epoch>,
    /// Readings that contradict those before and behind them, which agree: the host's time, and by how much, ns.
    pub strays: Vec<(i128, i128)>,
    /// Readings that were answered before they were requested: the host's time, ns.
    pub impossible: Vec<i128>,
}

impl Readings {
    /// From the recorded samples of one device.
    pub fn of<'a>(samples: impl Iterator<Item = &'a ClockSample>) -> Self {
        let mut all: Vec<Reading> = samples.map(Reading::of).collect();
        all.sort_by_key(|reading| (reading.sent, reading.received));
        let mut readings = Self::default();
        let impossible = all.iter().filter(|reading| reading.received < reading.sent);
        readings.impossible = impossible.map(|reading| reading.sent).collect();
        all.retain(|reading| reading.received >= reading.sent);
        let mut rest = all.iter().peekable();
        while let Some(reading) = rest.next() {
            let last =
                readings.epochs.last_mut().and_then(|epoch| Some((epoch.readings.last().copied()?, epoch)));
            let Some((last, epoch)) = last else {
                readings.epochs.push(Epoch { readings: vec![*reading] });
                continue;
            };
            let jump = last.jump_to(reading);
            if jump == 0 {
                epoch.readings.push(*reading);
            } else if rest.peek().is_some_and(|next| last.jump_to(next) == 0 && reading.jump_to(next) != 0) {
                readings.strays.push((reading.sent, jump));
            } else if readings.epochs.len() == EPOCHS {
                break;
            } else {
                readings.epochs.push(Epoch { readings: vec![*reading] });
            }
        }
        // A clock that was set keeps its setting, unless the session ends right behind it.
        let set = readings.epochs.len().saturating_sub(1);
        let few = readings.epochs.iter().take(set).filter(|epoch| !epoch.is_sustained());
        readings.strays.extend(few.map(|epoch| (epoch.begin_ns(), 0)));
        readings
    }

    /// The host's times of a device's time, one by each epoch that may have been in force at a time of the host.
    pub fn host_times(&self, device_ns: i128, host_ns: i128) -> impl Iterator<Item = HostTime> + '_ {
        let alone = self.epochs.len() == 1;
        let in_force = self.epochs.iter().filter(move |epoch| alone || epoch.covers(host_ns));
        in_force.take(IN_FORCE).filter_map(move |epoch| epoch.host_time(device_ns))
    }

    /// The epoch with most readings.
    pub fn longest(&self) -> Option<&Epoch> {
        self.epochs.iter().max_by_key(|epoch| epoch.readings.len())
    }

    /// Whether a new epoch begins around a time of the host.
    pub fn was_set_around(&self, host_ns: i128) -> bool {
        let begins = self.epochs.iter().skip(1).map(Epoch::begin_ns);
        begins.into_iter().any(|begin| (begin - host_ns).abs() <= BETWEEN_READINGS_NS)
    }

    /// The settings of the clock, as far as enough readings agree on both sides: the host's time, and by how much, ns.
    pub fn settings(&self) -> impl Iterator<Item = (i128, i128)> + '_ {
        let sustained: Vec<&Epoch> = self.epochs.iter().filter(|epoch| epoch.is_sustained()).collect();
        let pairs: Vec<(i128, i128)> = sustained
            .windows(2)
            .filter_map(|pair| {
                let (last, first) = (pair[0].readings.last()?, pair[1].readings.first()?);
                Some((pair[1].begin_ns(), last.jump_to(first)))
            })
            .filter(|(_, by)| *by != 0)
            .collect();
        pairs.into_iter()
    }
}

#[cfg(test)]
mod tests {
    use super::Readings;
    use crate::layout::ClockSample;

    /// A clock 70 s ahead that runs 50 ppm fast, read once a second, set back by 20 ms behind second 40.
    fn samples(round_trip_ns: impl Fn(u64) -> u64) -> Vec<ClockSample> {
        let sample = |second: u64| {
            let host_send_ns = 1_790_000_000_000_000_000 + second * 1_000_000_000;
            let at = host_send_ns + round_trip_ns(second) / 2;
            let since = at - 1_790_000_000_000_000_000;
            let set_ns = if second > 40 { 20_000_000 } else { 0 };
            let device_time_ns = 70_000_000_000 + since + since / 20_000 - set_ns;
            let host_receive_ns = host_send_ns + round_trip_ns(second);
            ClockSample { camera: None, host_send_ns, host_receive_ns, device_time_ns }
        };
        (0..80).map(sample).collect()
    }

    #[test]
    fn a_time_is_looked_up_among_the_readings_around_it() {
        let samples = samples(|second| if second % 3 == 0 { 25_000_000 } else { 100_000 });
        let readings = Readings::of(samples.iter());
        assert_eq!((readings.epochs.len(), readings.strays.len()), (2, 0));
        let settings: Vec<_> = readings.settings().collect();
        assert!(settings.len() == 1 && (-20_000_000..-18_000_000).contains(&settings[0].1), "{settings:?}");
        for second in 0..75u64 {
            let since = second * 1_000_000_000 + 400_000_000;
            let host = 1_790_000_000_000_000_000 + i128::from(since);
            let set_ns = if second > 40 { 20_000_000 } else { 0 };
            let device = i128::from(70_000_000_000 + since + since / 20_000) - set_ns;
            let right = |found: super::HostTime| {
                (found.ns - host).abs() <= found.open_ns + 1 && found.open_ns < 1_000_000
            };
            assert!(readings.host_times(device, host).any(right), "second {second}");
        }
    }

    #[test]
    fn one_wrong_reading_sets_no_clock() {
        let mut samples = samples(|_| 100_000);
        samples.truncate(40);
        samples[20].device_time_ns += 20_000_000;
        let readings = Readings::of(samples.iter());
        assert_eq!((readings.epochs.len(), readings.strays.len()), (1, 1));
        assert_eq!(readings.settings().count(), 0);
        samples[7].host_receive_ns -= 1_000_000;
        assert_eq!(Readings::of(samples.iter()).impossible.len(), 1);
        assert_eq!(Readings::of(samples[..1].iter()).epochs[0].host_time(5), None, "it may stand still");
    }
}
