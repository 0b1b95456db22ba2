// SPDX-License-Identifier: MIT OR Apache-2.0
//! Requirements on every camera, independent of the last user: automatic functions, corrections and image processing
//! off.

use super::plan::{Trouble, Wishes};
use super::trigger::is_delay;
use crate::camera::description::{Description, Feature, Kind, plain};
use crate::config::FeatureValue;

/// The value that a feature must have.
#[derive(Debug, Clone, PartialEq)]
pub enum Want {
    /// Exactly this value, without a tolerance.
    Value(FeatureValue),
    /// The least value that the camera takes.
    Least,
}

/// One requirement on a camera's feature.
#[derive(Debug, Clone, PartialEq)]
pub struct Must {
    /// Name of the feature as the camera spells it.
    pub feature: String,
    /// The value that it must have.
    pub want: Want,
    /// The selector behind each of whose entries the requirement holds.
    pub selector: Option<&'static str>,
    /// The switch that makes the feature irrelevant while it is off.
    pub unless_off: Option<&'static str>,
    /// Whether a camera that differs is refused; otherwise the difference is reported as a remark.
    pub strict: bool,
}

/// Switches that must be off, in small letters without the vendor's prefix; whether the camera is refused otherwise.
const SWITCHED_OFF: [(&str, bool); 30] = [
    ("gammaenable", true),
    ("gammaenabled", true),
    ("gammacorrectionenable", true),
    ("lutenable", true),
    ("lutenabled", true),
    ("reversex", true),
    ("reversey", true),
    ("reversescandirection", true),
    ("sequencermode", true),
    ("sequencerenable", true),
    ("sequenceenable", true),
    ("seqenable", true),
    ("sequencerconfigurationmode", true),
    // Where chunks stay on, the image is used and the chunks behind it are left out.
    ("chunkmodeactive", false),
    ("acquisitionframerateenable", true),
    ("acquisitionframerateenabled", true),
    ("framerateenable", true),
    ("acquisitionframeratemode", true),
    ("sharpnessmode", false),
    ("multishotenable", true),
    ("multipleroirowsenable", true),
    ("streamholdenable", true),
    ("sharpnessenable", false),
    ("sharpnessenabled", false),
    ("sharpeningenable", false),
    ("denoisingenable", false),
    // The byte order of deeper pixels is verified later, where it matters.
    ("gevscpsbigendian", false),
    ("pixelbigendian", false),
    ("ptpenable", false),
    ("gevieee1588", false),
];

/// Automatic functions that change the image, so that a camera with one of them on is refused.
const STRICT_AUTO: [&str; 11] = [
    "exposureauto",
    "gainauto",
    "blacklevelauto",
    "gammaauto",
    "digitalgainauto",
    "analoggainauto",
    "gainautobalance",
    "blacklevelautobalance",
    "sharpnessauto",
    "sharpeningauto",
    "irisauto",
];

/// Enumerations with one right entry: names, the entry's spellings, and whether the camera is refused without it.
const CHOSEN: [(&[&str], &[&str], bool); 4] = [
    (&["shuttermode", "sensorshuttermode"], &["Global", "GlobalShutter"], true),
    (&["devicestreamchannelendianness"], &["Little"], false),
    (&["lutmode"], &["Off", "Linear"], true),
    (&["transfercontrolmode"], &["Basic", "Automatic"], false),
];

/// Features that make one pixel of several, or leave pixels out.
const BINNING: [&str; 7] = [
    "binninghorizontal",
    "binningvertical",
    "binningmode",
    "decimationhorizontal",
    "decimationvertical",
    "subsamplinghorizontal",
    "subsamplingvertical",
];

/// Prefixes that vendors put before names of their own.
const VENDORS: [&str; 7] = ["bsl", "bo", "pgr", "tz", "exp", "dev", "mv"];

/// All requirements, in the order in which they are set: features that lock others first.
pub fn all(camera: &dyn Description, wishes: &Wishes) -> (Vec<Must>, Vec<Trouble>) {
    let (mut musts, mut troubles) = (Vec::new(), Vec::new());
    let mut names = camera.names();
    names.sort();
    for name in names {
        // A raw setting takes precedence.
        if wishes.raw.iter().any(|setting| setting.feature == name) {
            continue;
        }
        let Some(feature) = camera.feature(&name) else { continue };
        match rule(camera, &name, &feature, wishes) {
            Ok(must) => musts.extend(must),
            Err(trouble) => troubles.push(trouble),
        }
    }
    let rank = |must: &Must| {
        let name = plain(&must.feature);
        // A sequencer locks nearly everything, and automatic functions what they drive.
        (!name.contains("seq"), !name.contains("auto"), !name.contains("mode"))
    };
    musts.sort_by_key(rank);
    (musts, troubles)
}

fn must(name: &str, want: Want, strict: bool) -> Must {
    Must { feature: name.to_owned(), want, selector: selector_of(name), unless_off: None, strict }
}

/// The selector behind which a camera may have several of a feature.
fn selector_of(name: &str) -> Option<&'static str> {
    match name {
        "LUTEnable" | "LUTMode" => Some("LUTSelector"),
        "TestPattern" => Some("TestPatternGeneratorSelector"),
        "BinningHorizontal" | "BinningVertical" => Some("BinningSelector"),
        "DecimationHorizontal" | "DecimationVertical" => Some("DecimationSelector"),
        "GainAuto" => Some("GainSelector"),
        "BlackLevelAuto" => Some("BlackLevelSelector"),
        _ => None,
    }
}

fn text(entry: &str) -> Want {
    Want::Value(FeatureValue::Text(entry.to_owned()))
}

/// The value that means off for this feature; `None` where it cannot be off.
fn off(feature: &Feature) -> Option<Want> {
    match feature.kind {
        Kind::Boolean => Some(Want::Value(FeatureValue::Flag(false))),
        Kind::Enumeration => {
            feature.entry(&["Off", "Disabled", "Disable", "False", "None", "Manual"]).map(text)
        }
        _ => None,
    }
}

/// The value that means one to one for this feature.
fn one(feature: &Feature) -> Option<Want> {
    let is_one = |entry: &&String| {
        let mut digits = entry.split(|c: char| !c.is_ascii_digit()).filter(|digits| !digits.is_empty());
        digits.next() == Some("1") && digits.all(|digits| digits == "1")
    };
    match feature.kind {
        Kind::Integer => Some(Want::Value(FeatureValue::Integer(1))),
        Kind::Enumeration => feature
            .entry(&["Off"])
            .or_else(|| feature.entries.iter().find(is_one).map(String::as_str))
            .map(text),
        _ => None,
    }
}

/// The requirement for one feature; an error where a required entry is missing.
fn rule(
    camera: &dyn Description,
    name: &str,
    feature: &Feature,
    wishes: &Wishes,
) -> Result<Option<Must>, Trouble> {
    let whole = plain(name);
    let own = VENDORS.iter().find_map(|vendor| whole.strip_prefix(vendor)).unwrap_or(&whole);
    let is_among = |names: &[&str]| names.iter().any(|other| *other == whole || *other == own);
    // Actions are scheduled on the clock that PTP gives all cameras.
    if wishes.action.is_some_and(|action| action.ptp) && super::action::PTP_SWITCHES.contains(&name) {
        return Ok(None);
    }
    let switch = SWITCHED_OFF.iter().find(|(other, _)| is_among(&[other]));
    if let Some((_, strict)) = switch {
        return Ok(off(feature).map(|want| must(name, want, *strict)));
    }
    if let Some((_, entries, strict)) = CHOSEN.iter().find(|(names, ..)| names.contains(&whole.as_str())) {
        return Ok(feature.entry(entries).map(|entry| must(name, text(entry), *strict)));
    }
    let needed = |entries: &[&str], remedy: &str| match feature.entry(entries) {
        Some(entry) => Ok(Some(must(name, text(entry), true))),
        None => Err(Trouble::no_entry(name, entries[0], feature, remedy)),
    };
    // What must be so, and whether the camera is refused otherwise.
    let (want, strict) = match whole.as_str() {
        "acquisitionmode" if wishes.triggered => {
            return needed(&["Continuous"], "a session needs it: use another camera");
        }
        "exposuremode" if !wishes.left_to_settings("exposure_us") => {
            let remedy = "set its exposure in `settings`, and set left_to_settings = [\"exposure_us\"]";
            return needed(&["Timed", "Manual"], remedy);
        }
        "gamma" if feature.kind == Kind::Float => {
            let switch = ["GammaEnable", "GammaEnabled"].into_iter().find(|n| camera.feature(n).is_some());
            let want = Want::Value(FeatureValue::Float(1.0));
            return Ok(Some(Must { unless_off: switch, ..must(name, want, true) }));
        }
        "digitalshift" if feature.kind == Kind::Integer => {
            (Some(Want::Value(FeatureValue::Integer(0))), true)
        }
        "triggerdivider" | "triggermultiplier" | "framespertrigger" if wishes.triggered => {
            (one(feature), true)
        }
        "triggerdelayenabled" | "triggerdelayenable" if wishes.triggered => (off(feature), true),
        _ if is_delay(name, feature) && wishes.triggered => (Some(Want::Least), true),
        // These names are of no standard, and their numbers may mean something else.
        "binning" | "decimation" => (one(feature), false),
        _ if BINNING.contains(&own) => (one(feature), true),
        _ if is_test_image(own) || is_wide_range(own) => (off(feature), true),
        _ if is_automatic(&whole) => (off(feature), is_among(&STRICT_AUTO)),
        _ => return Ok(None),
    };
    Ok(want.map(|want| must(name, want, strict)))
}

fn is_test_image(name: &str) -> bool {
    ["testpattern", "testpatternmode", "testimageselector", "testimage", "testimagemode"].contains(&name)
        || (name.ends_with("testpattern") && name.len() < 20)
}

/// Whether a feature combines several exposures in one image.
fn is_wide_range(name: &str) -> bool {
    (name.contains("hdr") || name.contains("wdr")) && (name.ends_with("enable") || name.ends_with("enabled"))
        || name == "hdrmode"
}

fn is_automatic(name: &str) -> bool {
    let automatic = name.ends_with("auto") || name.ends_with("autobalance");
    // Not the frame rate, which is switched off, and not functions that no frame shows.
    let other = ["chunk", "event", "focus", "acquisitionframerate"].iter().any(|o| name.starts_with(o));
    automatic && !other
        || ["autogain", "autoexposure", "autogainenable", "autoexposureenable"].contains(&name)
}
