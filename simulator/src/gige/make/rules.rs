// SPDX-License-Identifier: MIT OR Apache-2.0
//! What firmware does that no description tells: plausible rules by names of features, each with its reason.
//!
//! A table states that something can lock a feature, hide it or bound it, not what. Here it is decided, once for all
//! makes.

use super::formats;
use super::table::{Access, Bound, Feature, Kind, Table};

/// Range and increment of a number.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Range {
    pub min: f64,
    pub max: f64,
    /// Increment of an integer; of a float 0, where every value is one.
    pub inc: f64,
}

/// What makes firmware refuse a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lock {
    Never,
    Acquiring,
    /// This automatic function, unless it is off; or the sequencer.
    Auto(&'static str),
}

/// The image's size, what it is made of and how it is packed: the receiver's buffers and the header of every frame rest
/// on them, so that all firmware keeps them while it acquires, whatever the description states.
const GEOMETRY: &[&str] = &[
    "Width",
    "Height",
    "PixelFormat",
    "BinningHorizontal",
    "BinningVertical",
    "DecimationHorizontal",
    "DecimationVertical",
    "ChunkModeActive",
    "ChunkEnable",
    "VideoMode",
    "AcquisitionMode",
    "AcquisitionFrameCount",
];
/// For these the description must state that something locks them: some firmware moves a region while it acquires, or
/// mirrors it.
const SOMETIMES: &[&str] =
    &["OffsetX", "OffsetY", "ReverseX", "ReverseY", "TriggerMode", "TestPattern", "TestImageSelector"];
/// Names of the exposure time, the first of which a camera has being the one that the others are derived from.
pub const EXPOSURE: &[&str] = &["ExposureTime", "ExposureTimeAbs", "ExposureTimeRaw"];
/// The names under which makes have the gain.
pub const GAIN: &[&str] = &["Gain", "GainRaw"];
/// Names of the frame rate.
pub const FRAME_RATE: &[&str] = &["AcquisitionFrameRate", "AcquisitionFrameRateAbs"];
/// Names of the switch that makes the frame rate count.
pub const FRAME_RATE_ENABLE: &[&str] = &["AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled"];
/// Names of what runs through sets of settings from frame to frame.
pub const SEQUENCER: &[&str] = &["SequencerMode", "SequenceEnable", "BoSequencerEnable"];
/// Names of the switch of the gamma.
pub const GAMMA_ENABLE: &[&str] = &["GammaEnable", "GammaEnabled"];
/// Names of the picture that replaces the sensor's.
pub const TEST_PATTERN: &[&str] = &["TestPattern", "TestImageSelector", "IRTestPattern"];

/// The condition under which a feature cannot be written.
pub fn lock(feature: &Feature) -> Lock {
    let name = feature.name.as_str();
    if GEOMETRY.contains(&name) {
        return Lock::Acquiring;
    }
    if !feature.locked_by {
        return Lock::Never;
    }
    // While an automatic function sets a value, writing it would be in vain: a description with "lockable" means it.
    if EXPOSURE.contains(&name) {
        return Lock::Auto("ExposureAuto");
    }
    if GAIN.contains(&name) {
        return Lock::Auto("GainAuto");
    }
    // Loading a set of settings would change the image's size under the receiver.
    let sets = name.starts_with("UserSet") && name != "UserSetSelector";
    if sets || SOMETIMES.contains(&name) {
        return Lock::Acquiring;
    }
    // A stop and a trigger are made for running acquisitions; the others that can be locked are what the transport is
    // made of.
    match feature.kind {
        Kind::Command => Lock::Never,
        _ if name.starts_with("GevSC") || name.starts_with("Stream") || name.starts_with("DeviceLink") => {
            Lock::Acquiring
        }
        _ => Lock::Never,
    }
}

/// The feature and its values that a feature needs to be there, where the description states that it can be away.
pub fn needs(feature: &Feature) -> Option<(&'static [&'static str], &'static [&'static str])> {
    if !feature.available_if {
        return None;
    }
    // With the mode of the trigger comes and goes what only a trigger that is on has.
    if feature.name == "TriggerOverlap" && feature.available_with.iter().any(|with| with == "TriggerMode") {
        return Some((&["TriggerMode"], &["On"]));
    }
    match feature.name.as_str() {
        // A trigger by command makes sense only where one was selected.
        "TriggerSoftware" => Some((&["TriggerSource"], &["Software", "SoftTrigger"])),
        // Its length is the pulse's, in the other mode.
        "ExposureTime" | "ExposureTimeAbs" | "ExposureTimeRaw" => Some((&["ExposureMode"], &["Timed"])),
        "AcquisitionFrameRate" | "AcquisitionFrameRateAbs" => Some((FRAME_RATE_ENABLE, &["On"])),
        "AcquisitionFrameCount" => Some((&["AcquisitionMode"], &["MultiFrame"])),
        "Gamma" => Some((GAMMA_ENABLE, &["On"])),
        "ChunkEnable" | "ChunkSelector" => Some((&["ChunkModeActive"], &["On"])),
        _ => None,
    }
}

/// Whether this model of the family has a feature. Tables name what any model of a family has; those that have `Mono8`
/// are simulated as the grey one with an area sensor.
pub fn implemented(table: &Table, feature: &Feature) -> bool {
    const COLOUR: &[&str] =
        &["Balance", "ColorTransformation", "ColorAdjustment", "ColorCoding", "Hue", "Saturation"];
    const LINE: &[&str] = &["LineStart", "LineTrigger", "TDI", "AcquisitionLine"];
    let any = |words: &[&str]| words.iter().any(|word| feature.name.starts_with(word));
    !(feature.implemented_if && is_grey(table) && (any(COLOUR) || any(LINE)))
}

/// Whether this model has an entry.
pub fn entry_implemented(table: &Table, feature: &Feature, entry: &str) -> bool {
    match feature.name.as_str() {
        "PixelFormat" => !is_grey(table) || formats::is_grey(entry),
        "TriggerSelector" => entry != "LineStart",
        _ => true,
    }
}

fn is_grey(table: &Table) -> bool {
    table.feature("PixelFormat").is_some_and(|feature| feature.entries.iter().any(|entry| entry == "Mono8"))
}

/// Who may do what with a feature. Where a description leaves it to registers that a table does not show, facts are
/// read only, and commands may be read: that is how a client learns that they are done.
pub fn access(feature: &Feature) -> Access {
    if feature.kind == Kind::Command {
        return feature.access.filter(|access| *access != Access::Ro).unwrap_or(Access::Rw);
    }
    // A number that cannot be read back would tell nothing to anybody; no description has one that matters here.
    if let Some(access) = feature.access.filter(|access| *access != Access::Wo) {
        return access;
    }
    const FACTS: &[&str] =
        &["SensorWidth", "SensorHeight", "WidthMax", "HeightMax", "PayloadSize", "ImageSize", "PixelSize"];
    let name = feature.name.as_str();
    let reported =
        ["Timestamp", "Status", "Version", "Temperature", "Increment", "FrameRateLimit", "EventData"];
    let chunk =
        name.starts_with("Chunk") && !["ChunkModeActive", "ChunkSelector", "ChunkEnable"].contains(&name);
    let event = name.ends_with("StreamChannelIndex");
    let fact = FACTS.contains(&name)
        || chunk
        || event
        || feature.kind != Kind::Enumeration && reported.iter().any(|word| name.contains(word));
    if fact { Access::Ro } else { Access::Rw }
}

/// The bounds of a number that a sensor's size does not decide.
pub fn range(feature: &Feature) -> Range {
    let name = feature.name.as_str();
    let (min, max, inc) = match (name, feature.kind) {
        // Line times, at the shortest, and a second.
        ("ExposureTime" | "ExposureTimeAbs" | "ExposureTimeRaw", _) => (10.0, 1_000_000.0, 1.0),
        ("Gain", Kind::Float) => (0.0, 24.0, 0.0),
        // Steps of an amplifier do not begin at 0: 0 is refused, as by real ones.
        ("GainRaw" | "Gain", _) => (33.0, 512.0, 1.0),
        ("AcquisitionFrameRate" | "AcquisitionFrameRateAbs", _) => (0.1, 1000.0, 0.0),
        ("Gamma", _) => (0.25, 4.0, 0.0),
        ("TriggerDelay" | "TriggerDelayAbs", _) => (0.0, 1_000_000.0, 0.0),
        ("BinningHorizontal" | "BinningVertical" | "DecimationHorizontal" | "DecimationVertical", _) => {
            (1.0, 4.0, 1.0)
        }
        ("AcquisitionFrameCount" | "AcquisitionBurstFrameCount", _) => (1.0, 255.0, 1.0),
        ("GevSCPSPacketSize", _) => (220.0, 9014.0, 4.0),
        ("LUTIndex" | "LUTValue", _) => (0.0, 4095.0, 1.0),
        (_, Kind::Float) => (-1e9, 1e9, 0.0),
        _ => match (feature.min, feature.max) {
            (Bound::Absent, Bound::Absent) => (-2_147_483_648.0, 4_294_967_295.0, 1.0),
            _ => (0.0, 65_535.0, 1.0),
        },
    };
    let fixed = |bound: Bound, else_: f64| match bound {
        Bound::Fixed(value) => value,
        Bound::Absent | Bound::Depends => else_,
    };
    let (mut low, mut high) = (fixed(feature.min, min), fixed(feature.max, max));
    // One of the two is the table's, the other a guess that may lie beyond it.
    if low > high {
        match feature.min {
            Bound::Fixed(_) => high = low,
            _ => low = high,
        }
    }
    let inc = if feature.kind == Kind::Float { 0.0 } else { fixed(feature.inc, inc).round().max(1.0) };
    Range { min: low, max: high, inc }
}

/// What a number is in the user set `Default`, before its bounds are applied.
pub fn default_number(table: &Table, feature: &Feature) -> f64 {
    match feature.name.as_str() {
        "ExposureTime" | "ExposureTimeAbs" | "ExposureTimeRaw" => 5000.0,
        "AcquisitionFrameRate" | "AcquisitionFrameRateAbs" => 30.0,
        // Behind a switch it is set to something, or the switch would do nothing.
        "Gamma" if GAMMA_ENABLE.iter().any(|name| table.find(name).is_some()) => 0.5,
        "Gamma" => 1.0,
        name if name.ends_with("Gain") || name.ends_with("GainRaw") => f64::MIN,
        _ => 0.0,
    }
}

/// The entry of an enumeration in the user set `Default`.
pub fn default_entry(table: &Table, feature: &Feature) -> usize {
    let wanted: &[&str] = match feature.name.as_str() {
        "PixelFormat" => &["Mono8"],
        "AcquisitionMode" => &["Continuous"],
        "ExposureMode" => &["Timed", "ContinuousProgrammable"],
        "TriggerActivation" => &["RisingEdge"],
        // Nothing triggers a camera that is new, nothing is automatic, and triggers during readout are ignored.
        _ => &["Off", "Disabled", "None", "Default"],
    };
    let there = |entry: &&String| entry_implemented(table, feature, entry);
    let find = |name: &&str| feature.entries.iter().position(|entry| entry == *name);
    let first = feature.entries.iter().position(|entry| there(&entry)).unwrap_or(0);
    wanted.iter().find_map(find).unwrap_or(first)
}

/// Entries that name a line of the trigger source, the likeliest input of a wire first.
pub fn wired_line(table: &Table) -> Option<String> {
    let entries = &table.feature("TriggerSource")?.entries;
    let first = |is: &dyn Fn(&str) -> bool| entries.iter().find(|entry| is(entry)).cloned();
    first(&|entry| entry == "Line0")
        .or_else(|| first(&|entry| entry == "Line1"))
        .or_else(|| first(&|entry| entry.starts_with("Line")))
        .or_else(|| first(&|entry| entry.starts_with("Ext")))
        .or_else(|| first(&|entry| entry != "Software" && entry != "Off"))
}

/// The factor from a value to the same by another of its names: an amplifier's step is a tenth of a decibel, a raw
/// exposure counts microseconds.
pub fn alias_scale(name: &str) -> f64 {
    if name == "GainRaw" { 10.0 } else { 1.0 }
}

/// Increment of a size or an offset: what is not stated is four columns, as words on a bus, and two rows.
pub fn pixels(feature: &Feature) -> f64 {
    match feature.inc {
        Bound::Fixed(inc) => inc.round().max(1.0),
        Bound::Absent | Bound::Depends if feature.name == "Width" || feature.name == "OffsetX" => 4.0,
        Bound::Absent | Bound::Depends => 2.0,
    }
}

/// Entries, by how they begin, that make a camera without trigger modes wait for its input.
pub const EXTERNAL: &[(&str, &[&str])] = &[
    ("ExposureMode", &["Async", "PulseWidthControl"]),
    ("SyncMode", &["ExtSync"]),
    ("SensorExternalSync", &["Slave"]),
];
