// SPDX-License-Identifier: MIT OR Apache-2.0
//! The plan of a set-up: what a session requires of a camera, the writes that follow, and what prevents them.

use crate::camera::description::{Description, Feature, list, nearest};
use crate::config::{
    ActionConfig, CameraConfig, CameraWords, Channel, FeatureSetting, FeatureValue, NodeConfig, Pixel,
};
use std::fmt;
use std::net::Ipv4Addr;

/// What a session requires of a camera: the node file, the rig, and the network.
#[derive(Debug, Clone)]
pub struct Wishes {
    /// The node file's keys for this camera.
    pub words: CameraWords,
    /// Raw settings, which are made after the keys.
    pub raw: Vec<FeatureSetting>,
    /// The rig's exposure, microseconds, for a node file without one.
    pub exposure_us: f64,
    /// Columns and rows of the image in the rig file.
    pub size: (usize, usize),
    /// Colour channel of the camera's head.
    pub channel: Channel,
    /// Whether the HSU triggers the frames; on a bench a camera may run free.
    pub triggered: bool,
    /// The keys of action commands, where these trigger the camera instead of a line.
    pub action: Option<ActionConfig>,
    /// The network between the camera and this host.
    pub link: Link,
}

/// The network between a camera and this host.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Link {
    /// Cameras of this node that send into the same network, this one included.
    pub cameras: usize,
    /// Size of a packet, bytes with all headers.
    pub packet_bytes: u32,
    /// Time between two triggers, ns.
    pub period_ns: u64,
}

impl Wishes {
    /// The requirements for one of a node file's cameras.
    pub fn of(config: &NodeConfig, camera: &CameraConfig) -> Self {
        let (head, known) = config.rig.cameras().find(|(_, known)| known.id == camera.id).unzip();
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
            size: known.map_or((0, 0), |known| (known.device.width, known.device.height)),
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

    /// Whether a key is left to the raw settings (`left_to_settings`).
    pub fn left_to_settings(&self, word: &str) -> bool {
        self.words.left_to_settings.iter().any(|left| left == word)
    }

    /// The required exposure: the node file's, else the rig's, microseconds.
    pub fn exposure_us(&self) -> f64 {
        self.words.exposure_us.unwrap_or(self.exposure_us)
    }
}

/// The value that a feature is set to.
#[derive(Debug, Clone, PartialEq)]
pub enum Amount {
    /// Exactly this value, without a tolerance.
    Value(FeatureValue),
    /// The camera's value nearest to a number in the unit of the key.
    Near {
        /// The number that the node file or the rig requires.
        wanted: f64,
        /// How the feature counts in relation to the key.
        scale: Scale,
        /// Largest difference between the camera's value and the wanted number.
        tolerance: f64,
        /// Unit of number and tolerance, for messages.
        unit: &'static str,
    },
    /// The least value that the camera takes.
    Least,
}

/// How many of a feature's units are one of the key's.
#[derive(Debug, Clone, PartialEq)]
pub enum Scale {
    /// A constant factor from the key's unit to the feature's.
    Times(f64),
    /// The feature counts ticks; the named feature holds the length of a tick in microseconds.
    Ticks(String),
    /// The feature counts ticks of the camera's clock, and the key microseconds.
    Clock,
    /// Decibels where zero is among the values, a factor where the least value is about one.
    Gain,
}

/// One feature to set, and how.
#[derive(Debug, Clone, PartialEq)]
pub struct Write {
    /// Name of the feature as the camera spells it.
    pub feature: String,
    /// The value that it is set to.
    pub amount: Amount,
    /// The key of the node file behind it; empty where there is none.
    pub word: &'static str,
    /// A refusal does no harm, because the outcome that matters is checked afterwards.
    pub optional: bool,
}

impl Write {
    pub(super) fn new(feature: &str, amount: Amount, word: &'static str) -> Self {
        Self { feature: feature.to_owned(), amount, word, optional: false }
    }

    pub(super) fn entry(feature: &str, entry: &str, word: &'static str) -> Self {
        Self::new(feature, Amount::Value(FeatureValue::Text(entry.to_owned())), word)
    }

    pub(super) fn optional(self) -> Self {
        Self { optional: true, ..self }
    }
}

/// Why a camera cannot be used as the node file requests.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Trouble {
    /// Name of the feature that the message is about.
    pub feature: String,
    /// What was expected, what was found and what to do.
    pub message: String,
}

impl Trouble {
    /// A message about a feature.
    pub fn new(feature: &str, message: impl Into<String>) -> Self {
        Self { feature: feature.to_owned(), message: message.into() }
    }

    /// The message that an enumeration lacks an entry.
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

/// The writes that set a camera up for a session, and what prevents it from being used.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Plan {
    /// The features to set, in this order.
    pub writes: Vec<Write>,
    /// Everything that prevents the camera from being used.
    pub troubles: Vec<Trouble>,
    /// What the operator should know about the camera.
    pub remarks: Vec<String>,
    /// The chosen entry of `PixelFormat`, as the camera spells it, and its meaning; none where it is left to settings.
    pub pixel_format: Option<(String, Pixel)>,
}

impl Plan {
    /// Adds writes, or the reason why there are none.
    pub(super) fn add(&mut self, found: Result<impl IntoIterator<Item = Write>, Trouble>) {
        match found {
            Ok(writes) => self.writes.extend(writes),
            Err(trouble) => self.troubles.push(trouble),
        }
    }

    /// Bytes of an image, 8-bit grey where its format is not known.
    pub(super) fn image_bytes(&self, wishes: &Wishes) -> usize {
        let pixel = self.pixel_format.as_ref().map_or(Pixel::Mono8, |(_, pixel)| *pixel);
        pixel.sent_bytes(wishes.size)
    }
}

/// The first of these features that the camera has and lets be written.
pub(super) fn first_writable<'a>(camera: &dyn Description, names: &[&'a str]) -> Option<(&'a str, Feature)> {
    let find = |name: &&'a str| Some((*name, camera.feature(name).filter(Feature::is_writable)?));
    names.iter().find_map(find)
}

/// A number that can be written.
pub(super) fn writable_number(camera: &dyn Description, name: &str) -> Option<Feature> {
    camera.feature(name).filter(|feature| feature.is_writable() && feature.is_number())
}

/// The message that the camera has none of these features.
pub(super) fn none_of(camera: &dyn Description, names: &[&str], what: &str, word: &str) -> Trouble {
    let wanted = names.first().copied().unwrap_or_default();
    let near = nearest(wanted, &camera.names());
    let near = if near.is_empty() { String::new() } else { format!("; nearest names: {}", list(&near)) };
    Trouble::new(
        wanted,
        format!(
            "no feature of this camera {what} (looked for {}){near}; set it by its own feature in `settings`, and set \
             left_to_settings = [\"{word}\"]",
            names.join(", ")
        ),
    )
}
