// SPDX-License-Identifier: MIT OR Apache-2.0
//! The time scale of a camera's clock: found from how far it is ahead of the host's clock, which counts UTC.
//!
//! PTP's own scale is TAI. A grandmaster may hand out another one, or count from wherever it began, and a camera does
//! not report which. So it is measured, as well as the host's clock is right.

use super::layout::ClockSample;
use crate::base::ids::CameraId;
use serde::Serialize;
use std::fmt;

/// TAI minus UTC, ns: 37 s since the last leap second that was inserted.
const TAI_AHEAD_NS: i64 = 37_000_000_000;
/// A host whose clock is kept by NTP or PTP is nearer to UTC than this.
const NEAR_NS: u64 = 500_000_000;

/// The time scale that a clock counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub enum TimeScale {
    /// International atomic time, since 1970-01-01 00:00:00 TAI: PTP's own.
    #[serde(rename = "TAI")]
    Tai,
    /// Universal time, since 1970-01-01 00:00:00 UTC, without leap seconds: the host's.
    #[serde(rename = "UTC")]
    Utc,
    /// Neither TAI nor UTC: a scale of its own.
    #[serde(rename = "own")]
    Own,
}

/// A clock's scale, and by how much it is ahead of the host's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct ScaleFound {
    /// What it counts, as well as the host's clock is right.
    pub scale: TimeScale,
    /// Ahead of the host's clock, ns: the middle of the recorded readings.
    pub minus_host_ns: i64,
}

impl ScaleFound {
    /// Finds the scale by the recorded readings of a camera's clock; `None` where there are none.
    pub fn of(camera: &CameraId, samples: &[ClockSample]) -> Option<Self> {
        let ahead = |sample: &ClockSample| {
            let host = (i128::from(sample.host_send_ns) + i128::from(sample.host_receive_ns)) / 2;
            i64::try_from(i128::from(sample.device_time_ns) - host).ok()
        };
        let own = samples.iter().filter(|sample| sample.camera.as_ref() == Some(camera));
        let mut ahead: Vec<i64> = own.filter_map(ahead).collect();
        ahead.sort_unstable();
        let minus_host_ns = *ahead.get(ahead.len() / 2)?;
        let scale = match minus_host_ns {
            ns if ns.abs_diff(TAI_AHEAD_NS) <= NEAR_NS => TimeScale::Tai,
            ns if ns.unsigned_abs() <= NEAR_NS => TimeScale::Utc,
            _ => TimeScale::Own,
        };
        Some(Self { scale, minus_host_ns })
    }
}

impl fmt::Display for TimeScale {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl fmt::Display for ScaleFound {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let word = match self.scale {
            TimeScale::Tai => "TAI",
            TimeScale::Utc => "UTC",
            TimeScale::Own => "neither TAI nor UTC",
        };
        write!(f, "{word}, {:.3} s ahead of the host's clock (UTC)", self.minus_host_ns as f64 / 1e9)
    }
}

/// A host clock's name with its scale.
pub fn host_scale(clock: &str) -> String {
    if clock == "CLOCK_REALTIME" { format!("{clock} (UTC)") } else { clock.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::{ScaleFound, TimeScale};
    use crate::base::ids::CameraId;
    use crate::layout::ClockSample;

    #[test]
    fn a_clocks_scale_is_told_by_how_far_it_is_ahead_of_the_host() {
        let camera = CameraId::from("h0_up");
        let sample = |device_time_ns: i64| ClockSample {
            camera: Some(camera.clone()),
            host_send_ns: 1_790_000_000_000_000_000,
            host_receive_ns: 1_790_000_000_000_200_000,
            device_time_ns: device_time_ns.unsigned_abs(),
        };
        let found = |ahead_ns: i64| {
            // One reading that went wrong changes nothing.
            let samples =
                [ahead_ns, 5_000_000_000_000, ahead_ns].map(|ns| sample(1_790_000_000_000_100_000 + ns));
            ScaleFound::of(&camera, &samples).expect("readings")
        };
        assert_eq!(found(37_020_000_000).scale, TimeScale::Tai);
        assert_eq!(found(37_020_000_000).to_string(), "TAI, 37.020 s ahead of the host's clock (UTC)");
        assert_eq!(found(-20_000_000).scale, TimeScale::Utc);
        for ahead_ns in [36_000_000_000, 38_000_000_000, -1_789_999_000_000_000_000] {
            assert_eq!(found(ahead_ns).scale, TimeScale::Own);
        }
        assert_eq!(TimeScale::Tai.to_string(), "TAI");
        assert_eq!(ScaleFound::of(&CameraId::from("h1_up"), &[sample(1)]), None);
    }
}
