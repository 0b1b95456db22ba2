// SPDX-License-Identifier: MIT OR Apache-2.0
//! The settings of a make for a session, as somebody writes them into a node's file who knows that camera.

use super::table::Kind;
use super::{Make, rules};

/// Entries of a trigger selector of which one starts frames, the likeliest first.
const STARTS: &[&str] = &["FrameStart", "ExposureStart", "FrameBurstStart"];

impl Make {
    /// Features in their order, with their values as TOML has them.
    pub fn session_settings(
        &self,
        (width, height): (usize, usize),
        exposure_us: f64,
    ) -> Vec<(String, String)> {
        let table = &self.table;
        let mut list = Vec::new();
        let mut set = |name: &str, value: String| {
            if table.find(name).is_some() {
                list.push((name.to_owned(), value));
            }
        };
        let has = |name: &str, entry: &str| {
            table.feature(name).is_some_and(|feature| feature.entries.iter().any(|known| known == entry))
        };
        if has("PixelFormat", "Mono8") {
            set("PixelFormat", "\"Mono8\"".to_owned());
        }
        set("Width", width.to_string());
        set("Height", height.to_string());
        let start = STARTS.iter().find(|entry| has("TriggerSelector", entry));
        for entry in ["AcquisitionStart", "FrameBurstStart"] {
            if has("TriggerSelector", entry) && start != Some(&entry) {
                set("TriggerSelector", format!("{entry:?}"));
                set("TriggerMode", "\"Off\"".to_owned());
            }
        }
        // A selector that cannot be written has one entry that counts.
        let fixed = |name: &str| {
            table.feature(name).is_some_and(|feature| rules::access(feature) == super::table::Access::Ro)
        };
        if let Some(start) = start.filter(|_| !fixed("TriggerSelector")) {
            set("TriggerSelector", format!("{start:?}"));
        }
        set("TriggerMode", "\"On\"".to_owned());
        if let Some(wire) = &self.wire {
            set("TriggerSource", format!("{wire:?}"));
        }
        if has("TriggerActivation", "RisingEdge") {
            set("TriggerActivation", "\"RisingEdge\"".to_owned());
        }
        if has("TriggerOverlap", "ReadOut") && !fixed("TriggerOverlap") {
            set("TriggerOverlap", "\"ReadOut\"".to_owned());
        }
        let number = |name: &str, value: f64| match table.feature(name).map(|feature| feature.kind) {
            Some(Kind::Integer) => format!("{}", value.round() as i64),
            _ => format!("{value:?}"),
        };
        if let Some(name) = rules::EXPOSURE.iter().find(|name| table.find(name).is_some()) {
            set(name, number(name, exposure_us));
        }
        if let Some(name) = rules::GAIN.iter().find(|name| table.find(name).is_some()) {
            let least = table.feature(name).map_or(0.0, |feature| rules::range(feature).min);
            set(name, number(name, least));
        }
        list
    }
}
