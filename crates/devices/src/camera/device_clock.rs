// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where a camera's clock is read, and in which unit: found out by reading it twice beside the host's clock.
//!
//! What features are called does not say in which unit they count, and a tick frequency may be 0, wrong or absent. So a
//! way to read the clock counts only when it keeps time with the host; none is guessed.

use super::features::{Failed, Features, answered};
use super::{CameraClockSample, CameraError};
use crate::base::time::monotonic_ns;
use std::time::{Duration, Instant};

const NANOSECONDS: u64 = 1_000_000_000;
/// Between the two readings that are compared.
const APART: Duration = Duration::from_millis(10);
/// Clocks may differ by this share: far more than any does, far less than a wrong unit.
const TOLERANCE: f64 = 0.02;

/// Bootstrap registers of GigE Vision: tick frequency and latched value (high word first), and the control register
/// whose bit 1 latches.
const FREQUENCY: [u64; 2] = [0x093c, 0x0940];
const CONTROL: u64 = 0x0944;
const LATCH: u32 = 2;
const VALUE: [u64; 2] = [0x0948, 0x094c];

/// One way to read a clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DeviceClock {
    reading: Reading,
    ticks_per_s: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Reading {
    /// A command and the number that it latches.
    Features { latch: &'static str, value: &'static str },
    /// A command and the two halves that it latches.
    Halves { latch: &'static str, high: &'static str, low: &'static str },
    /// The bootstrap registers.
    Registers,
}

impl Reading {
    /// In the order in which they are tried: SFNC 2, GigE Vision 1, USB3 Vision, bootstrap.
    const ALL: [Self; 5] = [
        Self::Features { latch: "TimestampLatch", value: "TimestampLatchValue" },
        Self::Features { latch: "GevTimestampControlLatch", value: "GevTimestampValue" },
        Self::Features { latch: "TimestampLatch", value: "Timestamp" },
        Self::Halves {
            latch: "GevTimestampControlLatch",
            high: "GevTimestampValueHigh",
            low: "GevTimestampValueLow",
        },
        Self::Registers,
    ];

    fn name(self) -> &'static str {
        match self {
            Self::Features { value, .. } => value,
            Self::Halves { high, .. } => high,
            Self::Registers => "the bootstrap registers' timestamp",
        }
    }

    fn is_there(self, camera: &dyn Features) -> bool {
        match self {
            Self::Features { latch, value } => camera.has(latch) && camera.has(value),
            Self::Halves { latch, high, low } => [latch, high, low].iter().all(|name| camera.has(name)),
            Self::Registers => camera.has_registers(),
        }
    }

    /// SFNC 2 counts nanoseconds, GigE Vision 1 ticks.
    fn units(self, camera: &dyn Features) -> Result<Vec<u64>, CameraError> {
        const FEATURE: &str = "GevTimestampTickFrequency";
        let mut units = Vec::new();
        if matches!(self, Self::Features { latch: "TimestampLatch", .. }) {
            units.push(NANOSECONDS);
        }
        if !matches!(self, Self::Registers) && camera.has(FEATURE) {
            let frequency = answered(camera.integer(FEATURE))?;
            units.extend(frequency.and_then(|frequency| u64::try_from(frequency).ok()));
        }
        if let Self::Halves { .. } = self {
            const HALVES: [&str; 2] = ["GevTimestampTickFrequencyHigh", "GevTimestampTickFrequencyLow"];
            if HALVES.iter().all(|name| camera.has(name)) {
                units.extend(answered(halves(camera, HALVES))?);
            }
        }
        if camera.has_registers() {
            units.extend(answered(wide(camera, FREQUENCY))?);
        }
        let mut known = Vec::new();
        units.into_iter().filter(|unit| *unit > 0).for_each(|unit| {
            if !known.contains(&unit) {
                known.push(unit);
            }
        });
        Ok(known)
    }

    /// Ticks between two readings of the host's clock.
    fn ticks(self, camera: &dyn Features) -> Result<(u64, u64, u64), Failed> {
        let before = monotonic_ns(Instant::now());
        match self {
            Self::Features { latch, .. } | Self::Halves { latch, .. } => camera.execute(latch)?,
            Self::Registers => camera.set_register(CONTROL, LATCH)?,
        }
        let after = monotonic_ns(Instant::now());
        let ticks = match self {
            // The sign is the transport's, not the clock's.
            Self::Features { value, .. } => camera.integer(value)?.cast_unsigned(),
            Self::Halves { high, low, .. } => halves(camera, [high, low])?,
            Self::Registers => wide(camera, VALUE)?,
        };
        Ok((before, ticks, after))
    }
}

/// A number in two features of 32 bits.
fn halves(camera: &dyn Features, [high, low]: [&str; 2]) -> Result<u64, Failed> {
    let half = |name| camera.integer(name).map(|half| half.cast_unsigned() & 0xffff_ffff);
    Ok(half(high)? << 32 | half(low)?)
}

/// A pair of registers.
fn wide(camera: &dyn Features, [high, low]: [u64; 2]) -> Result<u64, Failed> {
    Ok(u64::from(camera.register(high)?) << 32 | u64::from(camera.register(low)?))
}

/// The first way to read a camera's clock that keeps time with the host's, or why there is none.
///
/// # Errors
/// The camera does not answer.
pub fn find(camera: &dyn Features) -> Result<Result<DeviceClock, String>, CameraError> {
    let mut reasons = Vec::new();
    for reading in Reading::ALL.into_iter().filter(|reading| reading.is_there(camera)) {
        match find_unit(reading, camera)? {
            Ok(clock) => return Ok(Ok(clock)),
            Err(reason) => reasons.push(format!("{} {reason}", reading.name())),
        }
    }
    if reasons.is_empty() {
        reasons.push("none of its features is a clock".to_owned());
    }
    Ok(Err(reasons.join("; ")))
}

fn find_unit(reading: Reading, camera: &dyn Features) -> Result<Result<DeviceClock, String>, CameraError> {
    let read = || match reading.ticks(camera) {
        Ok(ticks) => Ok(Ok(ticks)),
        Err(Failed::Refused(why) | Failed::Nonsense(why)) => Ok(Err(format!("cannot be read ({why})"))),
        Err(Failed::Lost(error)) => Err(error),
    };
    let first = match read()? {
        Ok(first) => first,
        Err(reason) => return Ok(Err(reason)),
    };
    std::thread::sleep(APART);
    let second = match read()? {
        Ok(second) => second,
        Err(reason) => return Ok(Err(reason)),
    };
    if second.1 == first.1 {
        return Ok(Err("stands still".to_owned()));
    }
    let units = reading.units(camera)?;
    let fits = |ticks_per_s: &u64| keeps_time(first, second, *ticks_per_s);
    Ok(match units.iter().copied().find(fits) {
        Some(ticks_per_s) => Ok(DeviceClock { reading, ticks_per_s }),
        None if units.is_empty() => Err("moves, and its tick frequency is 0 or cannot be read".to_owned()),
        None => Err(format!(
            "does not keep time with this host by any frequency that the camera states ({units:?} Hz)"
        )),
    })
}

/// Whether two readings, each between two of the host's clock (ns), are as far apart as the host says.
fn keeps_time(first: (u64, u64, u64), second: (u64, u64, u64), ticks_per_s: u64) -> bool {
    let elapsed_ns = second.1.wrapping_sub(first.1) as f64 * 1e9 / ticks_per_s as f64;
    let least = second.0.saturating_sub(first.2) as f64 * (1.0 - TOLERANCE);
    let most = second.2.saturating_sub(first.0) as f64 * (1.0 + TOLERANCE);
    (least..=most).contains(&elapsed_ns)
}

impl DeviceClock {
    /// Reads it.
    pub fn sample(&self, camera: &dyn Features) -> Result<CameraClockSample, Failed> {
        let (host_before_ns, ticks, host_after_ns) = self.reading.ticks(camera)?;
        let ns = u128::from(ticks) * u128::from(NANOSECONDS) / u128::from(self.ticks_per_s);
        Ok(CameraClockSample {
            host_before_ns,
            camera_ns: u64::try_from(ns).unwrap_or(u64::MAX),
            host_after_ns,
        })
    }
}

/// What a camera says of PTP; `None` where it says nothing.
///
/// # Errors
/// The camera does not answer, or answers nonsense.
pub fn ptp_status(camera: &dyn Features) -> Result<Option<String>, CameraError> {
    for latch in ["PtpDataSetLatch", "GevIEEE1588DataSetLatch"] {
        if camera.has(latch) {
            // One that refuses tells its state as it is.
            answered(camera.execute(latch))?;
        }
    }
    for status in ["PtpStatus", "GevIEEE1588Status"] {
        if !camera.has(status) {
            continue;
        }
        match camera.text(status) {
            Ok(text) => return Ok(Some(text)),
            Err(Failed::Refused(_)) => {}
            Err(Failed::Lost(error)) => return Err(error),
            // By this its clock is believed: one that says no word of its own language is believed nothing.
            Err(Failed::Nonsense(what)) => {
                let detail = format!("{status} is {what}");
                return Err(CameraError::Nonsense { doing: "reading its PTP state", detail });
            }
        }
    }
    Ok(None)
}

#[cfg(test)]
mod tests {
    use super::keeps_time;

    #[test]
    fn only_the_right_unit_keeps_time() {
        // 10 ms apart, each reading within 1 ms, of a clock of 125 MHz.
        let (first, second) = ((0, 1_000_000, 1_000_000), (11_000_000, 2_300_000, 12_000_000));
        assert!(keeps_time(first, second, 125_000_000));
        assert!(!keeps_time(first, second, 1_000_000_000) && !keeps_time(first, second, 66_000_000));
        // Set back between the two.
        assert!(!keeps_time((0, 1 << 40, 1), (10_000_000, 5, 10_000_001), 1_000_000_000));
        assert!(!keeps_time(first, second, u64::MAX));
    }
}
