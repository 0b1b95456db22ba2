// SPDX-License-Identifier: MIT OR Apache-2.0
//! When projectors and cameras are triggered: the configuration of the unit.

use crate::MAX_HEADS;
use crate::codec::{DecodeError, Put, Take};
use crate::frame::crc32;
use core::fmt;

/// The event that starts each trigger.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum Sync {
    /// The unit's own timer, which also drives the projectors' sync inputs: their frame sync is the trigger.
    #[default]
    Timer = 0,
    /// The frame sync that the projectors send to the unit.
    ProjectorFrame = 1,
}

/// Delay and exposure of one head's channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct HeadTiming {
    /// From the projector's frame sync to the cameras' rising edge, ns.
    pub delay_ns: u64,
    /// How long the cameras' line is held: the exposure window, ns.
    pub exposure_ns: u64,
}

/// The timing of a train: period, source, and a channel for each head.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timing {
    /// From trigger to trigger, ns.
    pub period_ns: u64,
    /// The event that starts each trigger.
    pub sync: Sync,
    /// A link on which nothing was heard for this long is silent, ns.
    pub host_silence_ns: u64,
    heads: [HeadTiming; MAX_HEADS],
    head_count: u8,
}

/// Why a timing cannot be run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TimingError {
    /// The period lies outside 1 ms to 100 s.
    Period,
    /// No heads, or more than [`MAX_HEADS`].
    HeadCount,
    /// A head's exposure is empty, or its delay and exposure do not end within the period.
    Head(u8),
    /// The silence limit lies outside 100 ms to 60 s.
    HostSilence,
}

impl fmt::Display for TimingError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Period => f.write_str("expected a trigger period of 1 ms to 100 s"),
            Self::HeadCount => write!(f, "expected 1 to {MAX_HEADS} heads"),
            Self::Head(head) => write!(
                f,
                "head number {head}: expected an exposure above 0 that ends, with its delay, within the trigger period"
            ),
            Self::HostSilence => f.write_str("expected a host silence limit of 100 ms to 60 s"),
        }
    }
}

#[cfg(feature = "std")]
impl std::error::Error for TimingError {}

const PERIOD_NS: core::ops::RangeInclusive<u64> = 1_000_000..=100_000_000_000;
const HOST_SILENCE_NS: core::ops::RangeInclusive<u64> = 100_000_000..=60_000_000_000;

impl Timing {
    /// A timing that the unit can run, or what is wrong with it.
    pub fn new(
        period_ns: u64,
        sync: Sync,
        host_silence_ns: u64,
        heads: &[HeadTiming],
    ) -> Result<Self, TimingError> {
        if !PERIOD_NS.contains(&period_ns) {
            return Err(TimingError::Period);
        }
        if !HOST_SILENCE_NS.contains(&host_silence_ns) {
            return Err(TimingError::HostSilence);
        }
        let mut fixed = [HeadTiming::default(); MAX_HEADS];
        match fixed.get_mut(..heads.len()) {
            Some(place) if !heads.is_empty() => place.copy_from_slice(heads),
            _ => return Err(TimingError::HeadCount),
        }
        for (number, head) in heads.iter().enumerate() {
            if head.exposure_ns == 0 || head.delay_ns.saturating_add(head.exposure_ns) >= period_ns {
                return Err(TimingError::Head(number as u8));
            }
        }
        Ok(Self { period_ns, sync, host_silence_ns, heads: fixed, head_count: heads.len() as u8 })
    }

    /// The channels of the heads, in the order of their numbers.
    pub fn heads(&self) -> &[HeadTiming] {
        &self.heads[..usize::from(self.head_count)]
    }

    /// From a trigger to the end of the last exposure that it starts, ns.
    pub fn window_ns(&self) -> u64 {
        self.heads().iter().map(|h| h.delay_ns + h.exposure_ns).max().unwrap_or(0)
    }

    /// CRC-32 of the encoded timing, which each link repeats when it arms; 0 stands for "not configured".
    pub fn digest(&self) -> u32 {
        let mut buffer = [0; crate::MAX_MESSAGE];
        let mut put = Put::new(&mut buffer);
        self.put(&mut put);
        let length = put.length();
        crc32(&buffer[..length]).max(1)
    }

    pub(crate) fn put(&self, put: &mut Put<'_>) {
        put.u64(self.period_ns);
        put.u8(self.sync as u8);
        put.u64(self.host_silence_ns);
        put.u8(self.head_count);
        for head in self.heads() {
            put.u64(head.delay_ns);
            put.u64(head.exposure_ns);
        }
    }

    /// Outer error: unreadable; inner error: readable, but cannot be run.
    pub(crate) fn take(take: &mut Take<'_>) -> Result<Result<Self, TimingError>, DecodeError> {
        let period_ns = take.u64()?;
        let sync = match take.u8()? {
            0 => Sync::Timer,
            1 => Sync::ProjectorFrame,
            _ => return Err(DecodeError::Value),
        };
        let host_silence_ns = take.u64()?;
        let count = usize::from(take.u8()?);
        let mut heads = [HeadTiming::default(); MAX_HEADS];
        let Some(heads) = heads.get_mut(..count) else { return Err(DecodeError::Value) };
        for head in heads.iter_mut() {
            *head = HeadTiming { delay_ns: take.u64()?, exposure_ns: take.u64()? };
        }
        Ok(Self::new(period_ns, sync, host_silence_ns, heads))
    }
}
