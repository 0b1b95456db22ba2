// SPDX-License-Identifier: MIT OR Apache-2.0
//! Camera features that a client sets: their values, limits and defaults.

use super::gvsp::MONO8;
use super::picture::Picture;
use super::sensor;
use std::ops::RangeInclusive;
use std::time::Duration;

/// Limits of the exposure time, microseconds.
pub const EXPOSURE_US: RangeInclusive<f64> = 10.0..=1_000_000.0;
/// Lowest frame rate, Hz; the highest follows from exposure and readout.
pub const FRAME_RATE_MIN: f64 = 0.1;
/// Limits of the gain, dB.
pub const GAIN_DB: RangeInclusive<f64> = 0.0..=24.0;

macro_rules! coded {
    ($(#[$doc:meta])* $name:ident { $($(#[$entry_doc:meta])* $entry:ident = $code:literal),* $(,)? }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        #[repr(u32)]
        pub enum $name { $($(#[$entry_doc])* $entry = $code),* }

        impl $name {
            /// Entries as GenICam names them, with their register values.
            pub const ENTRIES: &[(&str, u32)] = &[$((stringify!($entry), $code)),*];

            /// The entry with this register value.
            pub fn from_code(code: u32) -> Option<Self> {
                match code { $($code => Some(Self::$entry),)* _ => None }
            }
        }
    };
}

coded! {
    /// How many frames an acquisition has.
    AcquisitionMode {
        Continuous = 0,
        SingleFrame = 1,
        /// As many frames as `AcquisitionFrameCount` has.
        MultiFrame = 2,
    }
}

coded! {
    ExposureMode {
        Timed = 0,
        /// The end of the trigger pulse.
        TriggerWidth = 1,
    }
}

coded! {
    /// What starts an exposure while the trigger mode is on.
    TriggerSource {
        Line0 = 0,
        Software = 1,
        /// Action commands that have the camera's keys.
        Action0 = 2,
    }
}

/// Which of a pulse's edges trigger.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Edge {
    Rising,
    Falling,
    Any,
}

/// Values of the camera's features.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    pub width: u32,
    pub height: u32,
    /// The number of frames of an acquisition.
    pub mode: AcquisitionMode,
    /// Frames of a multi-frame acquisition.
    pub frame_count: u32,
    /// The frame rate governs free running; otherwise the camera runs as fast as it can.
    pub frame_rate_enabled: bool,
    pub exposure_mode: ExposureMode,
    /// PFNC code of the pixels.
    pub pixel_format: u32,
    /// The trigger whose mode is read and set: 0 starts a frame, 1 the acquisition.
    pub selected_trigger: u32,
    /// Frames wait for a trigger of the acquisition, which no wire of this camera gives.
    pub acquisition_triggered: bool,
    /// Exposures start on triggers, not by themselves.
    pub triggered: bool,
    pub source: TriggerSource,
    /// Triggers by command start frames, too.
    pub software: bool,
    /// Which of a pulse's edges trigger.
    pub edge: Edge,
    /// From the edge to the exposure.
    pub delay: Duration,
    /// The number of frames of one trigger.
    pub burst: u32,
    /// An exposure begins only when the last readout has ended.
    pub apart: bool,
    /// Triggers that come sooner than this after the last one are ignored.
    pub pace: Option<Duration>,
    /// What it makes of the light.
    pub picture: Picture,
    frame_rate: f64,
    exposure_us: f64,
    gain_db: f64,
}

impl Settings {
    /// Power-on values: whole sensor, free running, 30 Hz, 1 ms.
    pub fn new(width: u32, height: u32) -> Self {
        Self {
            width,
            height,
            mode: AcquisitionMode::Continuous,
            frame_count: 1,
            frame_rate_enabled: true,
            exposure_mode: ExposureMode::Timed,
            pixel_format: MONO8,
            selected_trigger: 0,
            acquisition_triggered: false,
            triggered: false,
            source: TriggerSource::Line0,
            software: false,
            edge: Edge::Rising,
            delay: Duration::ZERO,
            burst: 1,
            apart: false,
            pace: None,
            picture: Picture::default(),
            frame_rate: 30.0,
            exposure_us: 1000.0,
            gain_db: 0.0,
        }
    }

    /// The same with an exposure time and a free-running rate that the caller has checked.
    #[must_use]
    pub fn with_times(self, exposure_us: f64, frame_rate: f64) -> Self {
        Self { exposure_us: exposure_us.clamp(0.0, 1e9), frame_rate: frame_rate.clamp(1e-3, 1e6), ..self }
    }

    /// The mode of the selected trigger.
    pub fn trigger_mode(&mut self) -> &mut bool {
        if self.selected_trigger == 0 { &mut self.triggered } else { &mut self.acquisition_triggered }
    }

    /// Whether the selected trigger is on.
    pub fn is_trigger_on(&self) -> bool {
        if self.selected_trigger == 0 { self.triggered } else { self.acquisition_triggered }
    }

    /// Whether an edge on the trigger input starts a frame.
    pub fn hears_edges(&self) -> bool {
        self.triggered && self.source == TriggerSource::Line0 && !self.acquisition_triggered
    }

    /// Whether an action command starts a frame.
    pub fn hears_actions(&self) -> bool {
        self.triggered && self.source == TriggerSource::Action0 && !self.acquisition_triggered
    }

    /// The exposure time as a feature states it, microseconds.
    pub fn exposure_us(&self) -> f64 {
        self.exposure_us
    }

    /// The exposure time as a duration.
    pub fn exposure(&self) -> Duration {
        Duration::from_nanos((self.exposure_us * 1000.0).round() as u64)
    }

    /// The frame rate without triggers, Hz.
    pub fn frame_rate(&self) -> f64 {
        self.frame_rate
    }

    /// Gain, dB. Stored and read back; the simulated light is not amplified.
    pub fn gain_db(&self) -> f64 {
        self.gain_db
    }

    /// Sets the exposure time where it is within limits; returns whether it was.
    pub fn set_exposure_us(&mut self, value: f64) -> bool {
        set(&mut self.exposure_us, value, EXPOSURE_US)
    }

    /// Sets the free-running rate where exposure and readout allow it; returns whether they do.
    pub fn set_frame_rate(&mut self, value: f64) -> bool {
        let fastest = 1.0 / sensor::shortest_period(self.exposure(), self.height).as_secs_f64();
        set(&mut self.frame_rate, value, FRAME_RATE_MIN..=fastest)
    }

    /// Sets the gain where it is within limits; returns whether it was.
    pub fn set_gain_db(&mut self, value: f64) -> bool {
        set(&mut self.gain_db, value, GAIN_DB)
    }

    /// Time between the starts of two free-running exposures.
    pub fn free_run_period(&self) -> Duration {
        let shortest = sensor::shortest_period(self.exposure(), self.height);
        if self.frame_rate_enabled {
            shortest.max(Duration::from_secs_f64(1.0 / self.frame_rate))
        } else {
            shortest
        }
    }

    /// Frames after which an acquisition ends by itself.
    pub fn frame_limit(&self) -> Option<u64> {
        match self.mode {
            AcquisitionMode::Continuous => None,
            AcquisitionMode::SingleFrame => Some(1),
            AcquisitionMode::MultiFrame => Some(u64::from(self.frame_count)),
        }
    }
}

fn set(place: &mut f64, value: f64, limits: RangeInclusive<f64>) -> bool {
    let valid = limits.contains(&value);
    if valid {
        *place = value;
    }
    valid
}
