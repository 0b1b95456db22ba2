// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a node file states of cameras in words of its own, whatever a camera calls its features: common to all cameras
//! (`[acquisition]`) and of one (`[[camera]]`).

use super::node::{FeatureSetting, FeatureValue};
use super::pixel::{Mosaic, Pixel};
use super::section::{Section, number};
use serde::{Deserialize, Serialize};

/// The value of a trigger line or a packet delay that the program finds by itself.
pub const AUTO: &str = "auto";

/// The edge of the trigger line that starts a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Edge {
    Rising,
    Falling,
}

/// The time between two packets of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum PacketDelay {
    /// Long enough that all cameras which share a network link can send at the same time.
    Auto,
    Microseconds(f64),
}

/// The words that a section states; `None`: it does not have the word.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct CameraWords {
    /// The camera's input that the HSU is wired to, or [`AUTO`].
    pub trigger_line: Option<String>,
    /// The edge that starts a frame.
    pub trigger_edge: Option<Edge>,
    pub exposure_us: Option<f64>,
    /// The most that the nearest exposure of the camera may differ from it, microseconds.
    pub exposure_tolerance_us: Option<f64>,
    pub gain_db: Option<f64>,
    /// The form of a pixel that the camera is to send.
    pub pixel: Option<Pixel>,
    /// Columns of the image, which must be those of the rig.
    pub width: Option<u64>,
    /// Rows of the image, which must be those of the rig.
    pub height: Option<u64>,
    /// Whether a trigger may come while the frame before it is read out.
    pub overlap: Option<bool>,
    /// The time between two packets.
    pub packet_delay: Option<PacketDelay>,
    /// Words that raw settings replace, because the camera's features for them follow no known rule.
    #[serde(default)]
    pub left_to_settings: Vec<String>,
}

/// The words, each with the features that it sets: raw settings name these only where the word is left to them.
pub const FEATURES_OF_WORDS: [(&str, &[&str]); 9] = [
    ("trigger_line", &["TriggerMode", "TriggerSource"]),
    ("trigger_edge", &["TriggerActivation"]),
    ("exposure_us", &["ExposureTime", "ExposureTimeAbs", "ExposureTimeRaw"]),
    ("gain_db", &["Gain", "GainAbs", "GainRaw"]),
    ("pixel", &["PixelFormat"]),
    ("width", &["Width"]),
    ("height", &["Height"]),
    ("overlap", &["TriggerOverlap"]),
    ("packet_delay_us", &["GevSCPD"]),
];

/// The word that sets this feature.
pub fn word_of(feature: &str) -> Option<&'static str> {
    FEATURES_OF_WORDS.iter().find(|(_, features)| features.contains(&feature)).map(|(word, _)| *word)
}

impl CameraWords {
    /// Reads the words of a section.
    pub(super) fn read(section: &Section<'_>) -> Self {
        const EDGES: [(&str, Edge); 2] = [("rising", Edge::Rising), ("falling", Edge::Falling)];
        let pixels = Pixel::GREY.into_iter().chain([Pixel::Bayer8(Mosaic::default())]);
        let pixels: Vec<(&str, Pixel)> = pixels.map(|pixel| (pixel.word(), pixel)).collect();
        // Reading a key makes it known to the section, whether it is there or not.
        let there = |key| section.value(key).is_some();
        let number = |key, range| there(key).then(|| section.number(key, range));
        let whole = |key| there(key).then(|| section.integer(key, 1..=65_536));
        Self {
            trigger_line: there("trigger_line").then(|| section.text("trigger_line")),
            trigger_edge: there("trigger_edge").then(|| section.choice("trigger_edge", &EDGES)),
            exposure_us: number("exposure_us", 0.1..=10_000_000.0),
            exposure_tolerance_us: number("exposure_tolerance_us", 0.0..=1_000_000.0),
            gain_db: number("gain_db", 0.0..=100.0),
            pixel: there("pixel").then(|| section.choice("pixel", &pixels)),
            width: whole("width"),
            height: whole("height"),
            overlap: there("overlap").then(|| section.flag_or("overlap", true)),
            packet_delay: there("packet_delay_us").then(|| read_packet_delay(section)),
            left_to_settings: read_left(section),
        }
    }

    /// These words, with the common ones where a word is missing.
    pub fn or(self, common: &Self) -> Self {
        // What a camera states itself it does not leave to a list for all cameras.
        let left = common.left_to_settings.iter().filter(|word| !self.has(word)).cloned();
        let left_to_settings = left.chain(self.left_to_settings.iter().cloned()).collect();
        Self {
            trigger_line: self.trigger_line.or_else(|| common.trigger_line.clone()),
            trigger_edge: self.trigger_edge.or(common.trigger_edge),
            exposure_us: self.exposure_us.or(common.exposure_us),
            exposure_tolerance_us: self.exposure_tolerance_us.or(common.exposure_tolerance_us),
            gain_db: self.gain_db.or(common.gain_db),
            pixel: self.pixel.or(common.pixel),
            width: self.width.or(common.width),
            height: self.height.or(common.height),
            overlap: self.overlap.or(common.overlap),
            packet_delay: self.packet_delay.or(common.packet_delay),
            left_to_settings,
        }
    }

    /// The words that are there, each under its own name.
    pub fn spoken(&self) -> Vec<FeatureSetting> {
        let text = |text: &str| FeatureValue::Text(text.to_owned());
        let edge = |edge| text(if edge == Edge::Rising { "rising" } else { "falling" });
        let whole = |number: u64| FeatureValue::Integer(i64::try_from(number).unwrap_or(i64::MAX));
        let delay = |delay| match delay {
            PacketDelay::Auto => text(AUTO),
            PacketDelay::Microseconds(delay) => FeatureValue::Float(delay),
        };
        let words = [
            ("trigger_line", self.trigger_line.as_deref().map(text)),
            ("trigger_edge", self.trigger_edge.map(edge)),
            ("exposure_us", self.exposure_us.map(FeatureValue::Float)),
            ("exposure_tolerance_us", self.exposure_tolerance_us.map(FeatureValue::Float)),
            ("gain_db", self.gain_db.map(FeatureValue::Float)),
            ("pixel", self.pixel.map(|pixel| text(pixel.word()))),
            ("width", self.width.map(whole)),
            ("height", self.height.map(whole)),
            ("overlap", self.overlap.map(FeatureValue::Flag)),
            ("packet_delay_us", self.packet_delay.map(delay)),
        ];
        let setting = |(word, value): (&str, Option<FeatureValue>)| {
            Some(FeatureSetting { feature: word.to_owned(), value: value? })
        };
        words.into_iter().filter_map(setting).collect()
    }

    /// Whether this word is there.
    fn has(&self, word: &str) -> bool {
        self.spoken().iter().any(|stated| stated.feature == word)
    }
}

fn read_left(section: &Section<'_>) -> Vec<String> {
    const KEY: &str = "left_to_settings";
    let known = FEATURES_OF_WORDS.map(|(word, _)| word);
    let mut left = Vec::new();
    for (i, value) in section.list(KEY).iter().enumerate() {
        match value.as_str().filter(|word| known.contains(word)) {
            Some(word) if section.has(word) => section.problem(
                &format!("{KEY}[{i}]"),
                format!("{} is there, too: give one of the two", section.path_of(word)),
            ),
            Some(word) => left.push(word.to_owned()),
            None => {
                let expected = known.join(", ");
                section.problem(&format!("{KEY}[{i}]"), format!("expected one of {expected}, found {value}"));
            }
        }
    }
    left
}

fn read_packet_delay(section: &Section<'_>) -> PacketDelay {
    const KEY: &str = "packet_delay_us";
    match section.value(KEY) {
        Some(toml::Value::String(text)) if text == AUTO => PacketDelay::Auto,
        Some(value) => {
            let delay = number(value).filter(|delay| (0.0..=100_000.0).contains(delay));
            if delay.is_none() {
                let expected = "expected microseconds from 0 to 100000, or \"auto\"";
                section.problem(KEY, format!("{expected}, found {value}"));
            }
            delay.map_or(PacketDelay::Auto, PacketDelay::Microseconds)
        }
        None => PacketDelay::Auto,
    }
}

/// Reads a list of raw settings. What a word sets must be left to it, here (`words`) or for all cameras (`common`).
pub(super) fn read_settings(
    section: &Section<'_>,
    words: &CameraWords,
    common: Option<&CameraWords>,
) -> Vec<FeatureSetting> {
    let is_left = |word: &str| {
        let here = words.left_to_settings.iter();
        here.chain(common.iter().flat_map(|common| &common.left_to_settings)).any(|left| left == word)
            && !words.has(word)
    };
    let mut settings = Vec::new();
    for (i, entry) in section.list("settings").iter().enumerate() {
        let key = format!("settings[{i}]");
        let value = entry.get(1).and_then(|value| value.clone().try_into::<FeatureValue>().ok());
        let (Some([toml::Value::String(feature), _]), Some(value)) =
            (entry.as_array().map(Vec::as_slice), value)
        else {
            section.problem(&key, format!("expected [\"FeatureName\", value], found {entry}"));
            continue;
        };
        if let Some(word) = word_of(feature).filter(|word| !is_left(word)) {
            section.problem(
                &key,
                format!(
                    "{feature} is what {} sets: give that, or {} = [\"{word}\"]",
                    section.path_of(word),
                    section.path_of("left_to_settings")
                ),
            );
        }
        settings.push(FeatureSetting { feature: feature.clone(), value });
    }
    settings
}
