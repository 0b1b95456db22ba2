// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a node file says of a camera, in the camera's own features: a pure function of its description.
//!
//! Names follow rules (SFNC 2, SFNC 1, GigE Vision before SFNC), not tables of models: docs/design/camera-profiles.md.

mod action;
mod gain;
mod image;
mod must;
mod time;
mod trigger;

pub use action::PTP_SWITCHES;
pub use image::uneven_rows;
pub use must::{Must, Want, all as must_be};
pub use trigger::{FRAME_TRIGGERS, frame_trigger, starts_a_frame, trigger_lines};

use super::description::{Access, Description, Feature, list, nearest};
use crate::config::{
    ActionConfig, CameraConfig, CameraWords, Channel, FeatureSetting, FeatureValue, NodeConfig, Pixel,
};
use std::fmt;
use std::net::Ipv4Addr;

/// What is wanted of a camera.
#[derive(Debug, Clone)]
pub struct Wishes {
    /// What the node file says in its own words.
    pub words: CameraWords,
    /// Raw settings, after the words.
    pub raw: Vec<FeatureSetting>,
    /// The exposure of the rig, for a file that does not say one; microseconds.
    pub exposure_us: f64,
    /// Columns and rows that the rig has for it.
    pub size: (usize, usize),
    /// The colour of its head.
    pub channel: Channel,
    /// Its frames are those of the HSU's triggers; a bench may let cameras run by themselves.
    pub triggered: bool,
    /// They are triggered by action commands instead of a line.
    pub action: Option<ActionConfig>,
    /// The network between it and this host.
    pub link: Link,
}

/// The network between a camera and this host.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Link {
    /// Cameras of this node that send into the same network, this one included.
    pub cameras: usize,
    /// Bytes of a packet, with all headers.
    pub packet_bytes: u32,
    /// Between two triggers, ns.
    pub period_ns: u64,
}

impl Wishes {
    /// What a node file says of one of its cameras.
    pub fn of(config: &NodeConfig, camera: &CameraConfig) -> Self {
        let mut known = config.rig.cameras().filter(|(_, known)| known.id == camera.id);
        let (head, device) =
            known.next().map_or((None, None), |(head, known)| (Some(head), Some(&known.device)));
        let network = |address: &str| {
            let [a, b, c, _] = address.parse::<Ipv4Addr>().ok()?.octets();
            Some([a, b, c])
        };
        let own = network(&camera.address);
        let beside = config.cameras.iter().filter(|other| own.is_some() && network(&other.address) == own);
        Self {
            words: camera.words.clone(),
            raw: camera.settings.clone(),
            exposure_us: head.map_or(0.0, |head| head.exposure_ns as f64 / 1000.0),
            size: device.map_or((0, 0), |device| (device.width, device.height)),
            channel: head.map_or(Channel::G, |head| head.channel),
            triggered: config.cameras_are_triggered(),
            action: config.trigger.action(),
            link: Link {
                cameras: beside.count().max(1),
                packet_bytes: config.packet_bytes,
                period_ns: (1e9 / config.rig.trigger_rate_hz) as u64,
            },
        }
    }

    /// Whether a word is left to the raw settings.
    pub fn left_to_settings(&self, word: &str) -> bool {
        self.words.left_to_settings.iter().any(|left| left == word)
    }

    /// The exposure that is wanted, microseconds.
    pub fn exposure_us(&self) -> f64 {
        self.words.exposure_us.unwrap_or(self.exposure_us)
    }
}

/// What a feature is to be set to.
#[derive(Debug, Clone, PartialEq)]
pub enum Amount {
    /// This value.
    Value(FeatureValue),
    /// The value nearest to a number, in the unit of its word.
    Near {
        /// The number.
        wanted: f64,
        /// How the feature counts.
        scale: Scale,
        /// By how much the camera's value may differ.
        tolerance: f64,
        /// Unit of both.
        unit: &'static str,
    },
    /// The least value that the camera takes.
    Least,
}

/// How many of a feature's units are one of the word's.
#[derive(Debug, Clone, PartialEq)]
pub enum Scale {
    /// So many.
    Times(f64),
    /// One for as many microseconds as this feature says.
    Ticks(String),
    /// Ticks of the camera's clock; the word counts microseconds.
    Clock,
    /// Decibels where zero is among the values, a factor where the least value is about one.
    Gain,
}

/// One feature to set.
#[derive(Debug, Clone, PartialEq)]
pub struct Write {
    /// Its name.
    pub feature: String,
    /// What to.
    pub amount: Amount,
    /// The word of the node file that asks for it; empty: none does.
    pub word: &'static str,
    /// It does no harm if the camera refuses it: what matters is asked afterwards.
    pub optional: bool,
}

impl Write {
    fn new(feature: &str, amount: Amount, word: &'static str) -> Self {
        Self { feature: feature.to_owned(), amount, word, optional: false }
    }

    fn entry(feature: &str, entry: &str, word: &'static str) -> Self {
        Self::new(feature, Amount::Value(FeatureValue::Text(entry.to_owned())), word)
    }

    fn optional(self) -> Self {
        Self { optional: true, ..self }
    }
}

/// Why a camera cannot be used as the node file says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Trouble {
    /// The feature that it is about.
    pub feature: String,
    /// What was expected, what was found and what to do.
    pub message: String,
}

impl Trouble {
    /// A trouble with a feature.
    pub fn new(feature: &str, message: impl Into<String>) -> Self {
        Self { feature: feature.to_owned(), message: message.into() }
    }

    /// A value that an enumeration does not have.
    pub fn no_entry(feature: &str, value: &str, has: &Feature, remedy: &str) -> Self {
        Self::new(
            feature,
            format!("`{value}` is not an entry of {feature}: {}; {remedy}", list(&has.entries)),
        )
    }
}

impl fmt::Display for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

/// What is to be done with a camera before a session.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Plan {
    /// In this order.
    pub writes: Vec<Write>,
    /// Everything that keeps the camera from being used.
    pub troubles: Vec<Trouble>,
    /// What an operator should know.
    pub told: Vec<String>,
    /// The entry of `PixelFormat` that is wanted, as the camera writes it, and what it is; none where it is left to settings.
    pub pixel_format: Option<(String, Pixel)>,
}

impl Plan {
    /// Bytes of an image, as far as its format is known.
    fn image_bytes(&self, wishes: &Wishes) -> usize {
        let pixel = self.pixel_format.as_ref().map_or(Pixel::Mono8, |(_, pixel)| *pixel);
        pixel.sent_bytes(wishes.size)
    }
}

/// How the words are said with a camera's features.
pub fn resolve(camera: &dyn Description, wishes: &Wishes) -> Plan {
    let mut plan = Plan::default();
    image::resolve(camera, wishes, &mut plan);
    time::exposure(camera, wishes, &mut plan);
    gain::resolve(camera, wishes, &mut plan);
    time::packet_delay(camera, wishes, &mut plan);
    // Last, because a trigger that is on locks what is set before.
    trigger::resolve(camera, wishes, &mut plan);
    plan
}

/// How a camera is brought into a known state, where it can be: its settings of delivery.
pub fn known_state(camera: &dyn Description) -> Option<(Write, &'static str)> {
    const LOAD: &str = "UserSetLoad";
    let selector = camera.feature("UserSetSelector")?;
    camera.feature(LOAD).filter(Feature::is_writable)?;
    let entry = selector.entry(&["Default", "Factory", "FactoryDefault", "UserSetDefault", "Standard"])?;
    Some((Write::entry("UserSetSelector", entry, "").optional(), LOAD))
}

/// The first of these features that the camera has and lets be written.
fn first_writable<'a>(camera: &dyn Description, names: &[&'a str]) -> Option<(&'a str, Feature)> {
    let find = |name: &&'a str| Some((*name, camera.feature(name).filter(Feature::is_writable)?));
    names.iter().find_map(find)
}

/// What to say of features none of which is there.
fn none_of(camera: &dyn Description, names: &[&str], what: &str, word: &str) -> Trouble {
    let wanted = names.first().copied().unwrap_or_default();
    let near = nearest(wanted, &camera.names());
    let near = match near.is_empty() {
        true => String::new(),
        false => format!("; nearest names: {}", list(&near)),
    };
    Trouble::new(
        wanted,
        format!(
            "no feature of this camera {what} (looked for {}){near}; set it by its own feature in `settings`, and say \
             left_to_settings = [\"{word}\"]",
            names.join(", ")
        ),
    )
}

/// A number that lies outside constant bounds.
fn check_bounds(name: &str, feature: &Feature, number: f64, word: &str) -> Result<(), Trouble> {
    let below = feature.bounds.min.is_some_and(|min| number < min);
    let above = feature.bounds.max.is_some_and(|max| number > max);
    if !below && !above {
        return Ok(());
    }
    let edge = |bound: Option<f64>| bound.map_or_else(|| "?".to_owned(), |bound| bound.to_string());
    let (min, max) = (edge(feature.bounds.min), edge(feature.bounds.max));
    let remedy = match word.is_empty() {
        true => String::new(),
        false => format!("; change {word}"),
    };
    Err(Trouble::new(name, format!("{name} takes {min} to {max}, asked for {number}{remedy}")))
}

/// Whether it can only be read.
fn is_fixed(feature: &Feature) -> bool {
    feature.access == Access::Read
}

#[cfg(test)]
pub(crate) mod tests;
