// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a bad serial line does to bytes: it delays messages, and flips, swallows and invents bytes.

use crate::random::Stream;
use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// The distribution of the delays of messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Jitter {
    /// Any delay up to the limit is as likely as any other.
    #[default]
    Uniform,
    /// Short ones mostly: exponential with a quarter of the limit as its mean, cut at the limit.
    Exponential,
}

/// What the serial lines do to what they carry, in both directions; nothing by default.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LineFaults {
    /// Makes it repeatable, as far as the bytes and their times are.
    pub seed: u64,
    /// The delay of every message at least.
    pub delay: Duration,
    /// And up to so much more, each by itself; messages never overtake each other.
    pub jitter: Duration,
    pub distribution: Jitter,
    /// Bytes out of a million that lose or gain one bit.
    pub flips_per_million: u32,
    /// Bytes out of a million that vanish.
    pub drops_per_million: u32,
    /// Bytes out of a million that another byte follows.
    pub inserts_per_million: u32,
}

impl LineFaults {
    /// Whether messages are held up at all.
    pub fn delays(&self) -> bool {
        !(self.delay + self.jitter).is_zero()
    }
}

/// One direction of one line.
#[derive(Debug)]
pub(super) struct Disturbance {
    faults: LineFaults,
    random: Stream,
    /// On their way, by the time of their arrival.
    held: VecDeque<(Instant, Vec<u8>)>,
    /// Arrival of the last message.
    last: Option<Instant>,
}

impl Disturbance {
    /// The direction called `name`, under the faults' seed.
    pub(super) fn new(faults: LineFaults, name: &str) -> Self {
        Self { faults, random: Stream::new(faults.seed, name), held: VecDeque::new(), last: None }
    }

    /// The bytes as they arrive, and how many places of them were disturbed.
    pub(super) fn bytes(&mut self, sent: &[u8]) -> (Vec<u8>, u32) {
        let LineFaults { flips_per_million, drops_per_million, inserts_per_million, .. } = self.faults;
        let (mut arriving, mut places) = (Vec::with_capacity(sent.len()), 0);
        if flips_per_million + drops_per_million + inserts_per_million == 0 {
            arriving.extend_from_slice(sent);
            return (arriving, 0);
        }
        let any_byte = |random: &mut Stream| (random.uniform() * 256.0) as u8;
        for &byte in sent {
            let [flips, drops, inserts] =
                [flips_per_million, drops_per_million, inserts_per_million].map(f64::from);
            let draw = self.random.uniform() * 1e6;
            if draw >= flips + drops + inserts {
                arriving.push(byte);
                continue;
            }
            places += 1;
            if draw < flips {
                arriving.push(byte ^ 1 << (any_byte(&mut self.random) % 8));
            } else if draw < flips + inserts {
                arriving.extend([byte, any_byte(&mut self.random)]);
            }
        }
        (arriving, places)
    }

    /// Takes a message that leaves now.
    pub(super) fn hold(&mut self, bytes: Vec<u8>, now: Instant) {
        let due = now + self.faults.delay + self.extra();
        let due = self.last.map_or(due, |last| due.max(last));
        self.last = Some(due);
        self.held.push_back((due, bytes));
    }

    fn extra(&mut self) -> Duration {
        let share = match self.faults.distribution {
            Jitter::Uniform => self.random.uniform(),
            Jitter::Exponential => (-0.25 * self.random.uniform().ln()).min(1.0),
        };
        self.faults.jitter.mul_f64(share)
    }

    /// The next message that has arrived.
    pub(super) fn arrived(&mut self, now: Instant) -> Option<Vec<u8>> {
        self.held.pop_front_if(|(due, _)| *due <= now).map(|(_, bytes)| bytes)
    }

    /// When the next message arrives.
    pub(super) fn next_due(&self) -> Option<Instant> {
        self.held.front().map(|(due, _)| *due)
    }

    /// Number of bytes that are delayed and not yet delivered.
    pub(super) fn held_bytes(&self) -> usize {
        self.held.iter().map(|(_, bytes)| bytes.len()).sum()
    }

    /// Whatever was on its way is lost.
    pub(super) fn clear(&mut self) {
        self.held.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::{Disturbance, Jitter, LineFaults};
    use hsu_firmware_proto::frame::{self, Decoder};
    use proptest::prelude::{any, prop, prop_assert, prop_assert_eq, proptest};
    use std::time::{Duration, Instant};

    proptest! {
        #[test]
        fn messages_arrive_late_in_order_and_whole(
            seed in any::<u64>(), exponential in any::<bool>(), gaps in prop::collection::vec(0u64..3_000, 1..200),
        ) {
            let distribution = if exponential { Jitter::Exponential } else { Jitter::Uniform };
            let (delay, jitter) = (Duration::from_micros(60), Duration::from_millis(2));
            let faults = LineFaults { seed, delay, jitter, distribution, ..LineFaults::default() };
            let (mut line, mut now) = (Disturbance::new(faults, "out"), Instant::now());
            let mut last = now;
            for (number, gap) in gaps.iter().enumerate() {
                now += Duration::from_micros(*gap);
                line.hold(vec![number as u8], now);
                let due = line.held.back().expect("just held").0;
                prop_assert!(due >= last && due >= now + delay, "never early, never before another");
                prop_assert!(due <= (now + delay + jitter).max(last), "never later than stated");
                last = due;
            }
            prop_assert_eq!(line.held_bytes(), gaps.len());
            let arrived: Vec<u8> = std::iter::from_fn(|| line.arrived(last)).flatten().collect();
            prop_assert_eq!(arrived, (0..gaps.len()).map(|n| n as u8).collect::<Vec<_>>());
            prop_assert_eq!(line.next_due(), None);
        }

        /// Flipped, swallowed and invented bytes cost the frames that they hit, and at most the one behind.
        #[test]
        fn the_framing_recovers(seed in any::<u64>(), rate in 100u32..3_000) {
            let faults = LineFaults {
                seed,
                flips_per_million: rate,
                drops_per_million: rate,
                inserts_per_million: rate,
                ..LineFaults::default()
            };
            let (mut line, mut decoder) = (Disturbance::new(faults, "in"), Decoder::new());
            let (mut hit, mut received, sent) = (0, Vec::new(), 400u16);
            for number in 0..sent {
                let mut framed = [0; frame::MAX_FRAME];
                // As in the protocol, the version is in front: no message begins with 0xff (invariant 8).
                let message = [[1, 7], number.to_le_bytes(), [0; 2], [9; 2]].concat();
                let length = frame::encode(&message, &mut framed);
                prop_assert!(length > 0, "{number} was refused");
                let (bytes, places) = line.bytes(&framed[..length]);
                hit += u16::from(places > 0);
                decoder.feed(&bytes, |message| received.push(message.to_vec()));
            }
            let numbers: Vec<u16> = received.iter().map(|m| u16::from_le_bytes([m[2], m[3]])).collect();
            prop_assert!(numbers.windows(2).all(|pair| pair[0] < pair[1]), "no frame twice, none out of order");
            prop_assert!(received.iter().all(|m| m[..2] == [1, 7] && m[4..] == [0, 0, 9, 9]), "no wrong frame passes");
            prop_assert!(received.len() as u16 + 2 * hit >= sent, "{hit} hit, {} received", received.len());
        }
    }

    #[test]
    fn an_exponential_delay_is_mostly_short() {
        let jitter = Duration::from_millis(2);
        let faults = LineFaults { jitter, distribution: Jitter::Exponential, ..LineFaults::default() };
        let mut line = Disturbance::new(faults, "out");
        let mean = (0..10_000).map(|_| line.extra().as_secs_f64()).sum::<f64>() / 1e4;
        assert!((0.00045..0.00052).contains(&mean), "a quarter of the limit, less what is cut: {mean}");
    }
}
