// SPDX-License-Identifier: MIT OR Apache-2.0
//! What must be so on every camera, whatever the last user left: automatic functions, corrections and tricks off.

use super::trigger::is_delay;
use super::{Trouble, Wishes};
use crate::camera::description::{Description, Feature, Kind, plain};
use crate::config::FeatureValue;

/// What a feature must be.
#[derive(Debug, Clone, PartialEq)]
pub enum Want {
    /// This value.
    Value(FeatureValue),
    /// The least that it takes.
    Least,
}

/// One thing that must be so.
#[derive(Debug, Clone, PartialEq)]
pub struct Must {
    /// The feature.
    pub feature: String,
    /// What it must be.
    pub want: Want,
    /// Behind every entry of this selector.
    pub selector: Option<&'static str>,
    /// It does not matter while this feature is off.
    pub unless_off: Option<&'static str>,
    /// Where it stays otherwise, the camera is refused; else it is told.
    pub strict: bool,
}

/// A feature that is one or the other, without the vendor's letters.
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
    // Where it stays on, the image is taken, and what follows it is left.
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
    // What is left of it is asked for where it matters.
    ("gevscpsbigendian", false),
    ("pixelbigendian", false),
    ("ptpenable", false),
    ("gevieee1588", false),
];

/// Automatic functions that change what a photograph shows.
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

/// Letters that vendors put before names of their own.
const VENDORS: [&str; 7] = ["bsl", "bo", "pgr", "tz", "exp", "dev", "mv"];

/// Everything that must be so, in the order in which it is set: what unlocks others first.
pub fn all(camera: &dyn Description, wishes: &Wishes) -> (Vec<Must>, Vec<Trouble>) {
    let (mut musts, mut troubles) = (Vec::new(), Vec::new());
    let mut names = camera.names();
    names.sort();
    for name in names {
        // What a raw setting names is as that says.
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

/// The selector behind which there may be several of a feature.
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

/// Off, as this feature says it; `None` where it cannot be off.
fn off(feature: &Feature) -> Option<Want> {
    match feature.kind {
        Kind::Boolean => Some(Want::Value(FeatureValue::Flag(false))),
        Kind::Enumeration => {
            feature.entry(&["Off", "Disabled", "Disable", "False", "None", "Manual"]).map(text)
        }
        // A switch that is a number, as before SFNC.
        Kind::Integer if feature.bounds.max == Some(1.0) => Some(Want::Value(FeatureValue::Integer(0))),
        _ => None,
    }
}

/// One to one, as this feature says it.
fn one(feature: &Feature) -> Option<Want> {
    match feature.kind {
        Kind::Integer => Some(Want::Value(FeatureValue::Integer(1))),
        Kind::Enumeration => {
            let is_one = |entry: &&String| {
                let digits: Vec<&str> =
                    entry.split(|c: char| !c.is_ascii_digit()).filter(|digits| !digits.is_empty()).collect();
                !digits.is_empty() && digits.iter().all(|digits| *digits == "1")
            };
            feature
                .entry(&["Off"])
                .or_else(|| feature.entries.iter().find(is_one).map(String::as_str))
                .map(text)
        }
        _ => None,
    }
}

fn rule(
    camera: &dyn Description,
    name: &str,
    feature: &Feature,
    wishes: &Wishes,
) -> Result<Option<Must>, Trouble> {
    let whole = plain(name);
    let own = VENDORS.iter().find_map(|vendor| whole.strip_prefix(vendor)).unwrap_or(&whole);
    let known = |list: &[(&str, bool)]| {
        list.iter().find(|(other, _)| *other == whole || *other == own).map(|(_, strict)| *strict)
    };
    // Actions are scheduled on the clock that PTP gives all cameras.
    if wishes.action.is_some_and(|action| action.ptp) && super::PTP_SWITCHES.contains(&name) {
        return Ok(None);
    }
    if let Some(strict) = known(&SWITCHED_OFF) {
        return Ok(off(feature).map(|want| must(name, want, strict)));
    }
    let needed = |entries: &[&str], remedy: &str| match feature.entry(entries) {
        Some(entry) => Ok(Some(must(name, text(entry), true))),
        None => Err(Trouble::no_entry(name, entries[0], feature, remedy)),
    };
    Ok(match whole.as_str() {
        "acquisitionmode" if wishes.triggered => {
            return needed(&["Continuous"], "a session needs it: use another camera");
        }
        "exposuremode" if !wishes.left_to_settings("exposure_us") => {
            let remedy = "set its exposure in `settings`, and say left_to_settings = [\"exposure_us\"]";
            return needed(&["Timed", "Manual"], remedy);
        }
        "shuttermode" | "sensorshuttermode" => {
            feature.entry(&["Global", "GlobalShutter"]).map(|entry| must(name, text(entry), true))
        }
        "devicestreamchannelendianness" => {
            feature.entry(&["Little"]).map(|entry| must(name, text(entry), false))
        }
        "lutmode" => feature.entry(&["Off", "Linear"]).map(|entry| must(name, text(entry), true)),
        "gamma" if feature.kind == Kind::Float => {
            let switch = ["GammaEnable", "GammaEnabled"].into_iter().find(|n| camera.feature(n).is_some());
            let want = Want::Value(FeatureValue::Float(1.0));
            Some(Must { unless_off: switch, ..must(name, want, true) })
        }
        "digitalshift" if feature.kind == Kind::Integer => {
            Some(must(name, Want::Value(FeatureValue::Integer(0)), true))
        }
        "transfercontrolmode" => {
            feature.entry(&["Basic", "Automatic"]).map(|entry| must(name, text(entry), false))
        }
        "triggerdivider" | "triggermultiplier" | "framespertrigger" if wishes.triggered => {
            one(feature).map(|want| must(name, want, true))
        }
        "triggerdelayenabled" | "triggerdelayenable" if wishes.triggered => {
            off(feature).map(|want| must(name, want, true))
        }
        _ if is_delay(name, feature) && wishes.triggered => Some(must(name, Want::Least, true)),
        // A number of no standard may count otherwise.
        "binning" | "decimation" => one(feature).map(|want| must(name, want, false)),
        _ if is_binning(own) => one(feature).map(|want| must(name, want, true)),
        _ if is_test_image(own) => off(feature).map(|want| must(name, want, true)),
        _ if is_wide_range(own) => off(feature).map(|want| must(name, want, true)),
        _ if is_automatic(&whole) => {
            let strict = STRICT_AUTO.iter().any(|auto| *auto == whole || *auto == own);
            off(feature).map(|want| must(name, want, strict))
        }
        _ => None,
    })
}

fn is_binning(name: &str) -> bool {
    const NAMES: [&str; 7] = [
        "binninghorizontal",
        "binningvertical",
        "binningmode",
        "decimationhorizontal",
        "decimationvertical",
        "subsamplinghorizontal",
        "subsamplingvertical",
    ];
    NAMES.contains(&name)
}

fn is_test_image(name: &str) -> bool {
    ["testpattern", "testpatternmode", "testimageselector", "testimage", "testimagemode"].contains(&name)
        || (name.ends_with("testpattern") && name.len() < 20)
}

/// Several exposures in one image.
fn is_wide_range(name: &str) -> bool {
    (name.contains("hdr") || name.contains("wdr")) && (name.ends_with("enable") || name.ends_with("enabled"))
        || name == "hdrmode"
}

fn is_automatic(name: &str) -> bool {
    let automatic = name.ends_with("auto") || name.ends_with("autobalance");
    // Not what drives a rate that is switched off, and not what no frame shows.
    let other = ["chunk", "event", "focus", "acquisitionframerate"].iter().any(|o| name.starts_with(o));
    automatic && !other
        || ["autogain", "autoexposure", "autogainenable", "autoexposureenable"].contains(&name)
}
