// SPDX-License-Identifier: MIT OR Apache-2.0
//! The trigger: one that starts a frame, by the HSU's line or by action commands, and no other.

use super::action;
use super::plan::{Amount, Plan, Trouble, Wishes, Write, first_writable};
use crate::camera::description::{Description, Feature, list, nearest, plain};
use crate::config::{AUTO, Edge, FeatureValue};

/// Entries of `TriggerSelector` that start a single frame; the first that a camera has is used.
pub const FRAME_TRIGGERS: [&str; 7] =
    ["FrameStart", "ExposureStart", "FrameBurstStart", "FrameTrigger", "ImageStart", "Frame", "Exposure"];

/// The only trigger of cameras that were designed before triggers of frames existed.
const BEFORE_FRAMES: &str = "acquisitionstart";

/// Whether the trigger of this name starts a single frame. A camera's only trigger does, whatever its name, unless
/// the name means the start or end of something else.
pub fn starts_a_frame(entry: &str, alone: bool) -> bool {
    let name = plain(entry);
    if alone && name == BEFORE_FRAMES {
        return true;
    }
    let other = ["acquisition", "line", "exposureactive", "frameactive"].iter().any(|o| name.starts_with(o))
        || name.ends_with("end");
    FRAME_TRIGGERS.iter().any(|known| plain(known) == name) || alone && !other
}

/// Entries of a trigger's mode that mean on.
pub const ON: [&str; 4] = ["On", "True", "Enabled", "Enable"];
/// Entries of a trigger's mode that mean off.
pub const OFF: [&str; 4] = ["Off", "False", "Disabled", "Disable"];

const LINE: &str = "trigger_line";
const MODE: &str = "TriggerMode";
const SELECTOR: &str = "TriggerSelector";
const SOURCE: &str = "TriggerSource";
const ACTIVATION: &str = "TriggerActivation";

/// The entry of `TriggerSelector` that starts a frame; `None` where the camera has one trigger alone.
pub fn frame_trigger(camera: &dyn Description) -> Result<Option<String>, Trouble> {
    let Some(selector) = camera.feature(SELECTOR) else { return Ok(None) };
    match (selector.entry(&FRAME_TRIGGERS), selector.entries.as_slice()) {
        (Some(entry), _) => Ok(Some(entry.to_owned())),
        (None, []) => Ok(None),
        (None, [alone]) if starts_a_frame(alone, true) => Ok(Some(alone.clone())),
        (None, _) => Err(Trouble::no_entry(
            SELECTOR,
            FRAME_TRIGGERS[0],
            &selector,
            "none of them starts a frame: use a camera that takes one frame for one edge of a line",
        )),
    }
}

/// Adds the trigger of frames: source, edge and overlap while it is off, then its mode. All other triggers are off.
pub fn resolve(camera: &dyn Description, wishes: &Wishes, plan: &mut Plan) {
    let wanted = wishes.triggered || wishes.words.trigger_line.is_some() || wishes.action.is_some();
    if !wanted || wishes.left_to_settings(LINE) {
        return;
    }
    let (on, off, frame) = match mode(camera) {
        Ok(found) => found,
        Err(trouble) => return plan.troubles.push(trouble),
    };
    if let Some(frame) = frame.as_deref().filter(|frame| plain(frame) == BEFORE_FRAMES) {
        plan.remarks.push(format!(
            "{SELECTOR} has {frame} alone: whether one edge takes one frame, and not a row of them, shows in the \
             warm-up"
        ));
    }
    let selector = camera.feature(SELECTOR).filter(|selector| selector.is_writable());
    if let (Some(selector), Some(frame)) = (&selector, &frame) {
        // Every other trigger is switched off. An entry that cannot be selected now is no trigger.
        for other in selector.entries.iter().filter(|other| *other != frame) {
            plan.writes.push(Write::entry(SELECTOR, other, LINE).optional());
            plan.writes.extend(off.as_ref().map(|off| Write::entry(MODE, off, LINE).optional()));
        }
        plan.writes.push(Write::entry(SELECTOR, frame, LINE));
    }
    // A trigger that is on may lock its source.
    plan.writes.extend(off.map(|off| Write::entry(MODE, &off, LINE).optional()));
    if let Some(keys) = wishes.action {
        action::keys(camera, keys, plan);
        plan.add(action::source(camera));
        if keys.ptp {
            plan.add(action::ptp(camera));
        }
    } else {
        let source = source(camera, wishes);
        if let Ok(Some(line)) = &source {
            input(camera, line, plan);
        }
        plan.add(source);
        let edge = edge(camera, wishes, &mut plan.remarks);
        plan.add(edge);
    }
    plan.add(overlap(camera, wishes));
    if frame.as_deref().is_some_and(|frame| plain(frame) == "frameburststart") {
        let one = Amount::Value(FeatureValue::Integer(1));
        let count = first_writable(camera, &["AcquisitionBurstFrameCount", "TriggerFrameCount"]);
        plan.writes.extend(count.map(|(name, _)| Write::new(name, one, LINE)));
    }
    plan.writes.push(Write::entry(MODE, &on, LINE));
}

/// The entries of the trigger's mode that are on and off, and the trigger that starts a frame.
fn mode(camera: &dyn Description) -> Result<(String, Option<String>, Option<String>), Trouble> {
    let Some(mode) = camera.feature(MODE) else {
        let near = list(&nearest(MODE, &camera.names()));
        return Err(Trouble::new(
            MODE,
            format!(
                "the camera has no {MODE}, and how a line makes it take a frame is not known (nearest names: {near}): \
                 set \
                 that up in `settings` and set left_to_settings = [\"{LINE}\"], or use another camera"
            ),
        ));
    };
    let Some(on) = mode.entry(&ON) else {
        let remedy = "set the trigger up in `settings`, and set left_to_settings = [\"trigger_line\"]";
        return Err(Trouble::no_entry(MODE, "On", &mode, remedy));
    };
    let off = mode.entry(&OFF);
    Ok((on.to_owned(), off.map(str::to_owned), frame_trigger(camera)?))
}

/// Makes the line an input whose signal is not inverted.
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

/// Whether an entry of a trigger's source names an input that can be wired.
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
        if wanted == AUTO {
            return Ok(None);
        }
        let message = format!(
            "the camera has no {SOURCE}, requested `{wanted}`: its trigger comes from one place alone, set {LINE} = \
             \"{AUTO}\""
        );
        return Err(Trouble::new(SOURCE, message));
    };
    let lines: Vec<&String> = feature.entries.iter().filter(|entry| is_line(entry)).collect();
    let entry = match (wanted, lines.as_slice()) {
        (AUTO, [line]) => line.as_str(),
        (AUTO, []) => {
            let remedy = format!("none of them is known as a line: set {LINE} = \"NAME\"");
            return Err(Trouble::no_entry(SOURCE, AUTO, &feature, &remedy));
        }
        (AUTO, [first, ..]) => {
            return Err(Trouble::new(
                SOURCE,
                format!(
                    "{SOURCE} has several lines ({}), and which of them the HSU is wired to cannot be known: set \
                     {LINE} = \"{first}\" or another of them",
                    list(&lines)
                ),
            ));
        }
        (line, _) => match feature.entry(&[line]) {
            Some(entry) => entry,
            None => {
                let remedy = match lines.first() {
                    Some(first) => {
                        format!("set {LINE} = \"{first}\" or another of them, as the HSU is wired")
                    }
                    None => format!("set {LINE} as the HSU is wired"),
                };
                return Err(Trouble::no_entry(SOURCE, line, &feature, &remedy));
            }
        },
    };
    if plain(entry).contains("software") || plain(entry) == "off" {
        let message = format!("{SOURCE} `{entry}` is no wire: expected the line that the HSU is wired to");
        return Err(Trouble::new(SOURCE, message));
    }
    Ok(Some(Write::entry(SOURCE, entry, LINE)))
}

/// The inputs that the HSU can be wired to: the sources that are lines, `Line0` and `Line1` first.
pub fn trigger_lines(camera: &dyn Description) -> Vec<String> {
    let Some(source) = camera.feature(SOURCE) else { return Vec::new() };
    let mut lines: Vec<String> = source.entries.iter().filter(|entry| is_line(entry)).cloned().collect();
    lines.sort_by_key(|line| !["line0", "line1"].contains(&plain(line).as_str()));
    lines
}

fn edge(
    camera: &dyn Description,
    wishes: &Wishes,
    remarks: &mut Vec<String>,
) -> Result<Option<Write>, Trouble> {
    const WORD: &str = "trigger_edge";
    if wishes.left_to_settings(WORD) {
        return Ok(None);
    }
    let stated = wishes.words.trigger_edge;
    let names: &[&str] = match stated.unwrap_or(Edge::Rising) {
        Edge::Rising => &["RisingEdge", "Rising", "PositiveEdge", "Positive", "ActiveHigh"],
        Edge::Falling => &["FallingEdge", "Falling", "NegativeEdge", "Negative", "ActiveLow"],
    };
    let Some((name, feature)) = first_of(camera, &[ACTIVATION, "TriggerPolarity"]) else {
        if stated != Some(Edge::Falling) {
            return Ok(None);
        }
        let message =
            format!("the camera has no {ACTIVATION}, requested {WORD} = \"falling\": set \"rising\"");
        return Err(Trouble::new(ACTIVATION, message));
    };
    if let Some(entry) = feature.entry(names) {
        return Ok(Some(Write::entry(name, entry, WORD)));
    }
    if stated.is_none() && feature.entries == ["None"] {
        remarks.push(format!(
            "{name} has None alone: look up in the camera's manual at which edge it exposes, expected the rising one"
        ));
        return Ok(None);
    }
    let other = feature.entries.first().map_or("", String::as_str);
    let remedy = format!(
        "if {other} is the right edge, set [\"{name}\", \"{other}\"] in `settings`, and set left_to_settings = \
         [\"{WORD}\"]"
    );
    Err(Trouble::no_entry(name, names[0], &feature, &remedy))
}

fn overlap(camera: &dyn Description, wishes: &Wishes) -> Result<Option<Write>, Trouble> {
    const WORD: &str = "overlap";
    if wishes.left_to_settings(WORD) {
        return Ok(None);
    }
    let wanted = wishes.words.overlap.unwrap_or(true);
    let names: &[&str] = match wanted {
        // Overlap with the readout alone: after a trigger during the exposure, the begin of the frame is not known.
        true => &["ReadOut", "On", "Enabled", "Overlap", "Overlapped", "PreviousFrame"],
        false => &["Off", "Disabled", "NonOverlap", "NonOverlapped"],
    };
    let all = ["TriggerOverlap", "TriggerOverlapMode", "OverlapMode", "ReadoutOverlap"];
    let Some((name, feature)) = first_of(camera, &all) else { return Ok(None) };
    match feature.entry(names) {
        Some(entry) => Ok(Some(Write::entry(name, entry, WORD))),
        None => Err(Trouble::no_entry(name, names[0], &feature, &format!("set {WORD} = {}", !wanted))),
    }
}

/// The first of these features that the camera has, whether it can be written or not.
fn first_of<'a>(camera: &dyn Description, names: &[&'a str]) -> Option<(&'a str, Feature)> {
    names.iter().find_map(|name| Some((*name, camera.feature(name)?)))
}

/// Whether a feature delays the selected trigger.
pub(super) fn is_delay(name: &str, feature: &Feature) -> bool {
    feature.is_number()
        && matches!(name, "TriggerDelay" | "TriggerDelayAbs" | "TriggerDelayRaw" | "TriggerDelayUs")
}
