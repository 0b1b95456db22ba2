// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which triggers of a camera are on. Either each trigger has its own mode behind the selector, or the camera has one
//! mode, which then applies to the selected trigger.

use super::description::plain;
use super::error::CameraError;
use super::features::{Features, answered, or_reason};
use super::profile::{FRAME_TRIGGERS, OFF, ON};

const SELECTOR: &str = "TriggerSelector";
const MODE: &str = "TriggerMode";

/// The triggers of a camera that are on.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TriggersOn {
    /// Each trigger's name, and its source where it has one.
    pub on: Vec<(String, Option<String>)>,
    /// Whether the camera has no more than one trigger.
    pub alone: bool,
    /// Why the triggers could not be determined.
    pub unknown: Option<String>,
}

/// Reads the mode of each trigger; the selector is left as it was.
pub fn triggers_on(camera: &dyn Features) -> Result<TriggersOn, CameraError> {
    let entries = camera.entries(SELECTOR);
    let mut found = TriggersOn { alone: entries.len() < 2, ..TriggersOn::default() };
    if !camera.has(MODE) {
        found.unknown = Some(format!("{MODE} cannot be read (it is not there), expected On"));
        return Ok(found);
    }
    // A selector that can only be read names the only trigger.
    let fixed = camera.feature(SELECTOR).is_some_and(|selector| !selector.is_writable());
    if found.alone || fixed {
        let selected = if fixed { answered(camera.text(SELECTOR))? } else { None };
        let selected = selected.or_else(|| entries.first().cloned());
        let name = selected.unwrap_or_else(|| FRAME_TRIGGERS[0].to_owned());
        match or_reason(camera.text(MODE))? {
            Ok(mode) if is_on(&mode) => found.on.push((name, source(camera)?)),
            Ok(_) => {}
            Err(why) => found.unknown = Some(format!("{MODE} cannot be read ({why}), expected On")),
        }
        return Ok(found);
    }
    let before = match or_reason(camera.text(SELECTOR))? {
        Ok(before) => before,
        Err(why) => {
            found.unknown = Some(format!("{SELECTOR} cannot be read ({why}), expected a trigger's name"));
            return Ok(found);
        }
    };
    for entry in entries {
        // An entry that cannot be selected, or has no mode of its own, is no trigger that could be on.
        if selected_mode(camera, &entry)?.is_some_and(|mode| is_on(&mode)) {
            found.on.push((entry, source(camera)?));
        }
    }
    if found.on.len() > 1 && is_one_mode(camera, &found, &before)? {
        found.on.retain(|(entry, _)| *entry == before);
    }
    answered(camera.set_text(SELECTOR, &before))?;
    Ok(found)
}

/// Whether all entries of the selector share one mode: switching it off at one entry switches it off at the others. The
/// modes are left as they were.
fn is_one_mode(camera: &dyn Features, found: &TriggersOn, selected: &str) -> Result<bool, CameraError> {
    let other = found.on.iter().find(|(entry, _)| entry != selected);
    let is_selected_on = found.on.iter().any(|(entry, _)| entry == selected);
    let mode = camera.feature(MODE);
    let ends = mode.as_ref().and_then(|mode| mode.entry(&ON).zip(mode.entry(&OFF)));
    let (Some((other, _)), true, Some((on, off))) = (other, is_selected_on, ends) else { return Ok(false) };
    if selected_mode(camera, other)?.is_none() || answered(camera.set_text(MODE, off))?.is_none() {
        return Ok(false);
    }
    let one = selected_mode(camera, selected)?.is_some_and(|mode| !is_on(&mode));
    // Restore the mode: through the selected trigger where there is one mode, else at the other trigger.
    if !one {
        answered(camera.set_text(SELECTOR, other))?;
    }
    answered(camera.set_text(MODE, on))?;
    Ok(one)
}

/// The mode behind an entry of the selector; `None` where either is refused.
fn selected_mode(camera: &dyn Features, entry: &str) -> Result<Option<String>, CameraError> {
    answered(camera.set_text(SELECTOR, entry).and_then(|()| camera.text(MODE)))
}

fn source(camera: &dyn Features) -> Result<Option<String>, CameraError> {
    answered(camera.text("TriggerSource"))
}

fn is_on(mode: &str) -> bool {
    ON.iter().any(|on| plain(on) == plain(mode))
}
