// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the values of a make's features come to: when it exposes, what it sends, what its pictures are like.

use super::firmware::Firmware;
use super::rules;
use crate::gige::gvsp::{Form, Payload};
use crate::gige::picture::Picture;
use crate::gige::settings::{AcquisitionMode, Edge, ExposureMode, Settings, TriggerSource};
use std::time::Duration;

/// What a trigger of a selector's entry does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    Frame,
    /// Starts a burst of frames.
    Burst,
    /// Starts a frame, and ends its exposure with the pulse.
    Bulb,
    Gate,
    End,
}

fn role(entry: &str) -> Role {
    match entry {
        "FrameStart" | "ExposureStart" => Role::Frame,
        "FrameBurstStart" => Role::Burst,
        "ExposureActive" => Role::Bulb,
        entry if entry.ends_with("End") => Role::End,
        _ => Role::Gate,
    }
}

/// Sources that are no wire: the camera triggers itself.
const ITSELF: &[&str] = &["Freerun", "FixedRate"];

/// Bytes of a chunk's tail, and of what is chosen to be appended.
const CHUNK: u32 = 8;

impl Firmware {
    /// A number that follows from others.
    pub(super) fn fact(&self, name: &str) -> Option<f64> {
        let (width, height) = self.reduced();
        Some(match name {
            "SensorWidth" => f64::from(self.sensor.0),
            "SensorHeight" => f64::from(self.sensor.1),
            "WidthMax" => f64::from(width),
            "HeightMax" => f64::from(height),
            "PayloadSize" | "ImageSize" => {
                let (width, height) = self.size();
                self.form(Form::default()).payload(width, height) as f64
            }
            _ => return None,
        })
    }

    fn size(&self) -> (u32, u32) {
        let of = |name| self.number(&[name]).map_or(1, |value| value.clamp(1.0, 16_384.0) as u32);
        (of("Width"), of("Height"))
    }

    /// What the payload of an image is; padding and packets as `habit` has them.
    pub fn form(&self, habit: Form) -> Form {
        let format = self.number(&["PixelFormat"]).unwrap_or(0.0) as u32;
        let chunks = self.is_on(&["ChunkModeActive"]);
        let chosen = if chunks && self.is_on(&["ChunkEnable"]) { 2 * CHUNK } else { 0 };
        let appended = habit.appended + if chunks { CHUNK + chosen } else { 0 };
        let payload = if chunks { Payload::ImageWithChunks } else { habit.payload };
        Form { format, told: format, appended, payload, ..habit }
    }

    /// Whether a trigger by command starts a frame.
    pub(super) fn takes_software_triggers(&self) -> bool {
        let settings = self.settings();
        settings.triggered && settings.software
    }

    /// What the stream must know.
    pub fn settings(&self) -> Settings {
        let (width, height) = self.size();
        let exposure_us = self.nearest_us.or_else(|| self.number(rules::EXPOSURE)).unwrap_or(1000.0);
        let rate = self.number(rules::FRAME_RATE).unwrap_or(30.0).max(0.1);
        let mut settings = Settings::new(width, height).with_times(exposure_us, rate);
        settings.mode = match self.entry("AcquisitionMode") {
            Some(mode) if mode.starts_with("SingleFrame") => AcquisitionMode::SingleFrame,
            Some("MultiFrame") => AcquisitionMode::MultiFrame,
            _ => AcquisitionMode::Continuous,
        };
        settings.frame_count = self.number(&["AcquisitionFrameCount"]).unwrap_or(1.0).max(1.0) as u32;
        settings.pixel_format = self.number(&["PixelFormat"]).unwrap_or(0.0) as u32;
        if rules::FRAME_RATE_ENABLE.iter().any(|name| self.make.table.find(name).is_some()) {
            settings.frame_rate_enabled = self.is_on(rules::FRAME_RATE_ENABLE);
            settings.pace = settings.frame_rate_enabled.then(|| Duration::from_secs_f64(1.0 / rate));
        }
        if matches!(self.entry("ExposureMode"), Some("TriggerWidth" | "PulseWidthControl")) {
            settings.exposure_mode = ExposureMode::TriggerWidth;
        }
        self.set_trigger(&mut settings);
        settings.picture = self.picture();
        settings
    }

    fn set_trigger(&self, settings: &mut Settings) {
        let table = &self.make.table;
        if table.find("TriggerMode").is_none() {
            // Cameras of before there were trigger modes: their exposure mode decides what starts it.
            settings.triggered = rules::EXTERNAL.iter().any(|(name, entries)| {
                self.entry(name).is_some_and(|entry| entries.iter().any(|start| entry.starts_with(start)))
            });
            return;
        }
        let Some(selector) = table.feature("TriggerSelector") else {
            if self.is_on(&["TriggerMode"]) {
                self.set_source(settings, "");
            }
            return;
        };
        // Where the mode is not behind the selector, what is selected is what is on.
        let is_on = |entry: &str| match self.is_behind("TriggerMode", "TriggerSelector") {
            true => self.entry_at("TriggerMode", entry) == Some("On"),
            false => self.entry("TriggerSelector") == Some(entry) && self.entry("TriggerMode") == Some("On"),
        };
        // Before there were triggers of frames, that of the acquisition started each.
        let alone = selector.entries.len() == 1;
        let role = |entry: &str| match role(entry) {
            Role::Gate if alone && entry == "AcquisitionStart" => Role::Frame,
            role => role,
        };
        let entries = selector.entries.iter().filter(|entry| is_on(entry));
        let on: Vec<(&str, Role)> = entries.map(|entry| (entry.as_str(), role(entry))).collect();
        let of = |wanted: &[Role]| on.iter().find(|(_, role)| wanted.contains(role)).copied();
        let start = of(&[Role::Frame, Role::Bulb]);
        let burst = of(&[Role::Burst]);
        // A trigger of what encloses frames that is on, and never comes: no frames.
        settings.acquisition_triggered = of(&[Role::Gate]).is_some() || start.is_some() && burst.is_some();
        if burst.is_some() && start.is_none() {
            settings.burst =
                self.number(&["AcquisitionBurstFrameCount"]).unwrap_or(1.0).clamp(1.0, 255.0) as u32;
        }
        if let Some((entry, role)) = start.or(burst) {
            if role == Role::Bulb {
                settings.exposure_mode = ExposureMode::TriggerWidth;
            }
            self.set_source(settings, entry);
        }
    }

    /// Source, edge, delay and overlap of the trigger that starts frames.
    fn set_source(&self, settings: &mut Settings, selected: &str) {
        let source = self.entry_at("TriggerSource", selected);
        if source.is_some_and(|source| ITSELF.contains(&source)) {
            return;
        }
        settings.triggered = true;
        // Without a choice there is one input.
        let any = source.is_none_or(|source| source == "Any");
        let wired = any || source == self.make.wire.as_deref();
        settings.software = any || matches!(source, Some("Software" | "SoftTrigger"));
        // Nothing comes over a line that nothing is connected to.
        settings.source = if wired { TriggerSource::Line0 } else { TriggerSource::Software };
        settings.edge = match self.entry_at("TriggerActivation", selected) {
            Some("FallingEdge" | "LevelLow") => Edge::Falling,
            Some("AnyEdge") => Edge::Any,
            _ => Edge::Rising,
        };
        let delays = !self.make.table.features.iter().any(|f| f.name == "TriggerDelayEnabled")
            || self.is_on(&["TriggerDelayEnabled"]);
        let delay = ["TriggerDelay", "TriggerDelayAbs"].iter().find_map(|name| self.value_at(name, selected));
        let delay_us = delay.filter(|_| delays).map_or(0.0, |value| value.number().clamp(0.0, 10_000_000.0));
        settings.delay = Duration::from_secs_f64(delay_us / 1e6);
        settings.apart = self.entry_at("TriggerOverlap", selected) == Some("Off");
    }

    fn picture(&self) -> Picture {
        let (x, y) = (self.number(&["OffsetX"]), self.number(&["OffsetY"]));
        let offset = |value: Option<f64>| value.unwrap_or(0.0).clamp(0.0, 16_384.0) as u32;
        let modes =
            ["BinningModeHorizontal", "BinningHorizontalMode", "BinningModeVertical", "BinningVerticalMode"];
        let binned = self.binning();
        let gamma = match rules::GAMMA_ENABLE.iter().any(|name| self.make.table.find(name).is_some()) {
            true if !self.is_on(rules::GAMMA_ENABLE) => 1.0,
            // A switch without a number is the standard curve of monitors.
            true => self.number(&["Gamma"]).unwrap_or(0.45),
            false => self.number(&["Gamma"]).unwrap_or(1.0),
        };
        let automatic = |name| self.is_on(&[name]) && self.entry(name) != Some("Once");
        Picture {
            offset: (offset(x), offset(y)),
            step: self.reduction(),
            summed: binned.then(|| !modes.iter().any(|m| self.entry(m).is_some_and(|e| e.starts_with("Av")))),
            mirror: (self.is_on(&["ReverseX"]), self.is_on(&["ReverseY"])),
            level: self.amplification(),
            gamma: gamma as f32,
            lut: self.is_on(&["LUTEnable"]),
            pattern: self.is_on(rules::TEST_PATTERN),
            automatic: automatic("ExposureAuto") || automatic("GainAuto"),
            sequenced: self.is_on(rules::SEQUENCER),
        }
    }

    fn binning(&self) -> bool {
        ["BinningHorizontal", "BinningVertical"].iter().any(|name| self.factor(name) > 1)
    }

    /// How much more its amplifier gives than at the smallest gain.
    fn amplification(&self) -> f32 {
        let Some(index) = rules::GAIN.iter().find_map(|name| self.make.table.find(name)) else { return 1.0 };
        let steps = self.value(index).number() - self.range(index).min;
        let decibels =
            if self.feature(index).kind == super::table::Kind::Float { steps } else { steps / 10.0 };
        10f64.powf(decibels.clamp(0.0, 60.0) / 20.0) as f32
    }

    /// The packet size that it uses where one is requested: its bounds hold, and what is between its increments is
    /// rounded down, as by real ones. `None`: refused.
    pub fn packet_size(&self, asked: u16) -> Option<u16> {
        let Some(index) = self.make.table.find("GevSCPSPacketSize") else { return Some(asked) };
        let range = rules::range(self.feature(index));
        let valid = (range.min..=range.max).contains(&f64::from(asked));
        let inc = (range.inc as u16).max(1);
        valid.then_some(asked - asked % inc)
    }

    /// The packet size after power-on.
    pub fn first_packet_size(&self) -> u16 {
        [9000u16, 8000, 1500, 1400, 576].into_iter().find_map(|size| self.packet_size(size)).unwrap_or(576)
    }
}
