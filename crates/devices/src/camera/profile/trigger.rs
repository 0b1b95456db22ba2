// SPDX-License-Identifier: MIT OR Apache-2.0
//! The trigger: one that starts a frame, by the HSU's line or by action commands, and no other.

use super::action;
use super::{Amount, Plan, Trouble, Wishes, Write, first_writable, is_fixed};
use crate::camera::description::{Description, Feature, list, nearest, plain};
use crate::config::{AUTO, Edge, FeatureValue};

/// Selectors of the triggers that start a single frame, the first that a camera has being taken.
pub const FRAME_TRIGGERS: [&str; 7] =
    ["FrameStart", "ExposureStart", "FrameBurstStart", "FrameTrigger", "ImageStart", "Frame", "Exposure"];

/// The trigger of cameras from before there was one of frames.
const BEFORE_FRAMES: &str = "acquisitionstart";

/// Whether the trigger of this name starts a single frame. One that is alone does, whatever it is called, unless its name says
/// that it starts or ends something else.
pub fn starts_a_frame(entry: &str, alone: bool) -> bool {
    let name = plain(entry);
    if alone && name == BEFORE_FRAMES {
        return true;
    }
    let other = ["acquisition", "line", "exposureactive", "frameactive"].iter().any(|o| name.starts_with(o))
        || name.ends_with("end");
    FRAME_TRIGGERS.iter().any(|known| plain(known) == name) || alone && !other
}

const LINE: &str = "trigger_line";
const MODE: &str = "TriggerMode";
const SELECTOR: &str = "TriggerSelector";
const SOURCE: &str = "TriggerSource";
const ACTIVATION: &str = "TriggerActivation";

/// The entry of `TriggerSelector` that starts a frame; `None` where the camera has one trigger alone.
pub fn frame_trigger(camera: &dyn Description) -> Result<Option<String>, Trouble> {
    let Some(selector) = camera.feature(SELECTOR) else { return Ok(None) };
    match selector.entry(&FRAME_TRIGGERS) {
        Some(entry) => Ok(Some(entry.to_owned())),
        None if selector.entries.is_empty() => Ok(None),
        None if selector.entries.len() == 1 && starts_a_frame(&selector.entries[0], true) => {
            Ok(selector.entries.first().cloned())
        }
        None => Err(Trouble::no_entry(
            SELECTOR,
            FRAME_TRIGGERS[0],
            &selector,
            "none of them starts a frame: use a camera that one edge of a line makes take one frame",
        )),
    }
}

pub fn resolve(camera: &dyn Description, wishes: &Wishes, plan: &mut Plan) {
    let wanted = wishes.triggered || wishes.words.trigger_line.is_some() || wishes.action.is_some();
    if !wanted || wishes.left_to_settings(LINE) {
        return;
    }
    let Some(mode) = camera.feature(MODE) else {
        let near = nearest(MODE, &camera.names());
        plan.troubles.push(Trouble::new(
            MODE,
            format!(
                "the camera has no {MODE}, and how a line makes it take a frame is not known (nearest names: {}): set \
                 that up in `settings` and say left_to_settings = [\"{LINE}\"], or use another camera",
                list(&near)
            ),
        ));
        return;
    };
    let Some(on) = mode.entry(&["On", "True", "Enabled", "Enable"]).map(str::to_owned) else {
        let remedy = "set the trigger up in `settings`, and say left_to_settings = [\"trigger_line\"]";
        return plan.troubles.push(Trouble::no_entry(MODE, "On", &mode, remedy));
    };
    let off = mode.entry(&["Off", "False", "Disabled", "Disable"]).map(str::to_owned);
    let frame = match frame_trigger(camera) {
        Ok(frame) => frame,
        Err(trouble) => return plan.troubles.push(trouble),
    };
    if let Some(frame) = frame.as_deref().filter(|frame| plain(frame) == BEFORE_FRAMES) {
        plan.told.push(format!(
            "{SELECTOR} has {frame} alone: that one edge takes one frame, and not a row of them, is seen in the warm-up"
        ));
    }
    let selector = camera.feature(SELECTOR).filter(|selector| !is_fixed(selector));
    if let (Some(selector), Some(frame)) = (&selector, &frame) {
        // What else could be waited for is off; an entry that cannot be selected now is no trigger.
        for other in selector.entries.iter().filter(|other| *other != frame) {
            plan.writes.push(Write::entry(SELECTOR, other, LINE).optional());
            plan.writes.extend(off.as_ref().map(|off| Write::entry(MODE, off, LINE).optional()));
        }
        plan.writes.push(Write::entry(SELECTOR, frame, LINE));
    }
    // A trigger that is on may lock its source.
    plan.writes.extend(off.map(|off| Write::entry(MODE, &off, LINE).optional()));
    match wishes.action {
        Some(keys) => {
            action::keys(camera, keys, plan);
            match action::source(camera) {
                Ok(write) => plan.writes.push(write),
                Err(trouble) => plan.troubles.push(trouble),
            }
            if keys.ptp {
                action::ptp(camera, plan);
            }
        }
        None => by_line(camera, wishes, plan),
    }
    match overlap(camera, wishes) {
        Ok(write) => plan.writes.extend(write),
        Err(trouble) => plan.troubles.push(trouble),
    }
    if frame.as_deref().is_some_and(|frame| plain(frame) == "frameburststart") {
        let one = Amount::Value(FeatureValue::Integer(1));
        let count = first_writable(camera, &["AcquisitionBurstFrameCount", "TriggerFrameCount"]);
        plan.writes.extend(count.map(|(name, _)| Write::new(name, one, LINE)));
    }
    plan.writes.push(Write::entry(MODE, &on, LINE));
}

/// The source is the HSU's line, and its edge.
fn by_line(camera: &dyn Description, wishes: &Wishes, plan: &mut Plan) {
    match source(camera, wishes) {
        Ok(Some(write)) => {
            input(camera, &write, plan);
            plan.writes.push(write);
        }
        Ok(None) => {}
        Err(trouble) => plan.troubles.push(trouble),
    }
    match edge(camera, wishes, &mut plan.told) {
        Ok(write) => plan.writes.extend(write),
        Err(trouble) => plan.troubles.push(trouble),
    }
}

/// The line is an input, and its signal is not turned round.
fn input(camera: &dyn Description, source: &Write, plan: &mut Plan) {
    let Amount::Value(FeatureValue::Text(line)) = &source.amount else { return };
    let Some((selector, lines)) = first_writable(camera, &["LineSelector"]) else { return };
    let Some(line) = lines.entry(&[line]) else { return };
    plan.writes.push(Write::entry(selector, line, LINE).optional());
    if let Some((mode, feature)) = first_writable(camera, &["LineMode"])
        && let Some(entry) = feature.entry(&["Input"])
    {
        plan.writes.push(Write::entry(mode, entry, LINE).optional());
    }
    if let Some((inverter, _)) = first_writable(camera, &["LineInverter"]) {
        plan.writes.push(Write::new(inverter, Amount::Value(FeatureValue::Flag(false)), LINE).optional());
    }
}

/// Whether an entry of a trigger's source is the name of an input that a wire can be put to.
fn is_line(entry: &str) -> bool {
    let name = plain(entry);
    // JAI's `Line5_OptIn1`, for instance.
    if name.strip_prefix("line").is_some_and(|rest| rest.starts_with(|c: char| c.is_ascii_digit())) {
        return true;
    }
    let stem = name.trim_end_matches(|c: char| c.is_ascii_digit());
    const STEMS: [&str; 20] = [
        "line",
        "input",
        "in",
        "io",
        "gpio",
        "gpin",
        "gpi",
        "opto",
        "optoin",
        "trigger",
        "triggerin",
        "triggerinput",
        "exttrig",
        "exttrigger",
        "externaltrigger",
        "external",
        "hardware",
        "ttlin",
        "pin",
        "cxpin",
    ];
    STEMS.contains(&stem)
}

fn source(camera: &dyn Description, wishes: &Wishes) -> Result<Option<Write>, Trouble> {
    let wanted = wishes.words.trigger_line.as_deref().unwrap_or(AUTO);
    let Some(feature) = camera.feature(SOURCE) else {
        return match wanted {
            AUTO => Ok(None),
            line => Err(Trouble::new(
                SOURCE,
                format!(
                    "the camera has no {SOURCE}, asked for `{line}`: its trigger comes from one place alone, say \
                     {LINE} = \"{AUTO}\""
                ),
            )),
        };
    };
    let lines: Vec<String> = feature.entries.iter().filter(|entry| is_line(entry)).cloned().collect();
    let entry = match wanted {
        AUTO => match lines.as_slice() {
            [line] => line.clone(),
            [] => {
                let remedy = format!("none of them is known as a line: say {LINE} = \"NAME\"");
                return Err(Trouble::no_entry(SOURCE, AUTO, &feature, &remedy));
            }
            several => {
                return Err(Trouble::new(
                    SOURCE,
                    format!(
                        "{SOURCE} has several lines ({}), and which of them the HSU is wired to cannot be known: say \
                         {LINE} = \"{}\" or another of them",
                        list(several),
                        several[0]
                    ),
                ));
            }
        },
        line => match feature.entry(&[line]) {
            Some(entry) => entry.to_owned(),
            None => {
                let remedy = match lines.first() {
                    Some(first) => {
                        format!("say {LINE} = \"{first}\" or another of them, as the HSU is wired")
                    }
                    None => format!("say {LINE} as the HSU is wired"),
                };
                return Err(Trouble::no_entry(SOURCE, line, &feature, &remedy));
            }
        },
    };
    if plain(&entry).contains("software") || plain(&entry) == "off" {
        let message = format!("{SOURCE} `{entry}` is no wire: expected the line that the HSU is wired to");
        return Err(Trouble::new(SOURCE, message));
    }
    Ok(Some(Write::entry(SOURCE, &entry, LINE)))
}

/// The inputs that the HSU can be wired to: entries of the trigger's source that are lines, `Line0` and `Line1` first.
pub fn trigger_lines(camera: &dyn Description) -> Vec<String> {
    let Some(source) = camera.feature(SOURCE) else { return Vec::new() };
    let mut lines: Vec<String> = source.entries.iter().filter(|entry| is_line(entry)).cloned().collect();
    lines.sort_by_key(|line| !["line0", "line1"].contains(&plain(line).as_str()));
    lines
}

fn edge(camera: &dyn Description, wishes: &Wishes, told: &mut Vec<String>) -> Result<Option<Write>, Trouble> {
    const WORD: &str = "trigger_edge";
    if wishes.left_to_settings(WORD) {
        return Ok(None);
    }
    let said = wishes.words.trigger_edge;
    let names: &[&str] = match said.unwrap_or(Edge::Rising) {
        Edge::Rising => &["RisingEdge", "Rising", "PositiveEdge", "Positive", "ActiveHigh"],
        Edge::Falling => &["FallingEdge", "Falling", "NegativeEdge", "Negative", "ActiveLow"],
    };
    let feature = ["TriggerActivation", "TriggerPolarity"].into_iter().find_map(|name| {
        let feature = camera.feature(name)?;
        Some((name, feature))
    });
    match feature {
        None if said != Some(Edge::Falling) => Ok(None),
        None => Err(Trouble::new(
            ACTIVATION,
            format!("the camera has no {ACTIVATION}, asked for {WORD} = \"falling\": say \"rising\""),
        )),
        Some((name, feature)) => match feature.entry(names) {
            Some(entry) => Ok(Some(Write::entry(name, entry, WORD))),
            None if said.is_none() && feature.entries == ["None"] => {
                told.push(format!(
                    "{name} has None alone: the camera's manual says at which edge it exposes, expected the rising one"
                ));
                Ok(None)
            }
            None => {
                let other = feature.entries.first().map_or("", String::as_str);
                let remedy = format!(
                    "if it is the right one as it is, set [\"{name}\", \"{other}\"] in `settings`, and say \
                     left_to_settings = [\"{WORD}\"]"
                );
                Err(Trouble::no_entry(name, names[0], &feature, &remedy))
            }
        },
    }
}

fn overlap(camera: &dyn Description, wishes: &Wishes) -> Result<Option<Write>, Trouble> {
    const WORD: &str = "overlap";
    if wishes.left_to_settings(WORD) {
        return Ok(None);
    }
    let wanted = wishes.words.overlap.unwrap_or(true);
    let names: &[&str] = match wanted {
        // Of a trigger during the exposure nothing is known when the frame begins: readout alone is meant.
        true => &["ReadOut", "On", "Enabled", "Overlap", "Overlapped", "PreviousFrame"],
        false => &["Off", "Disabled", "NonOverlap", "NonOverlapped"],
    };
    let all = ["TriggerOverlap", "TriggerOverlapMode", "OverlapMode", "ReadoutOverlap"];
    let found = all.into_iter().find_map(|name| Some((name, camera.feature(name)?)));
    let Some((name, feature)) = found else { return Ok(None) };
    let Some(entry) = feature.entry(names).map(str::to_owned) else {
        let remedy = format!("say {WORD} = {}", !wanted);
        return Err(Trouble::no_entry(name, names[0], &feature, &remedy));
    };
    Ok(Some(Write::entry(name, &entry, WORD)))
}

/// Whether a feature is one of the trigger that is selected, and must be as it is for frames to be taken at the edge.
pub(super) fn is_delay(name: &str, feature: &Feature) -> bool {
    feature.is_number()
        && matches!(name, "TriggerDelay" | "TriggerDelayAbs" | "TriggerDelayRaw" | "TriggerDelayUs")
}
