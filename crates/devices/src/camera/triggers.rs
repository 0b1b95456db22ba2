// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which triggers of a camera are on. Each has a mode of its own behind the selector, or there is one mode, which is then that
//! of the trigger that is selected.

use super::CameraError;
use super::description::plain;
use super::features::{Failed, Features, answered};
use super::profile::FRAME_TRIGGERS;

const SELECTOR: &str = "TriggerSelector";
const MODE: &str = "TriggerMode";

/// The triggers that are on, each with its source where it has one.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TriggersOn {
    /// Name and source.
    pub on: Vec<(String, Option<String>)>,
    /// There is one trigger alone.
    pub alone: bool,
    /// Why they cannot be known.
    pub unknown: Option<String>,
}

/// Asks each trigger of the selector, which is left as it was.
pub fn triggers_on(camera: &dyn Features) -> Result<TriggersOn, CameraError> {
    let entries = camera.entries(SELECTOR);
    let mut found = TriggersOn { alone: entries.len() < 2, ..TriggersOn::default() };
    if !camera.has(MODE) {
        found.unknown = Some(format!("{MODE} cannot be read (it is not there), expected On"));
        return Ok(found);
    }
    // A selector that can only be read says which trigger there is.
    let fixed = camera.feature(SELECTOR).is_some_and(|selector| !selector.is_writable());
    if found.alone || fixed {
        let selected = if fixed { answered(camera.text(SELECTOR))? } else { None };
        let selected = selected.or_else(|| entries.first().cloned());
        let name = selected.unwrap_or_else(|| FRAME_TRIGGERS[0].to_owned());
        match camera.text(MODE) {
            Ok(mode) if is_on(&mode) => found.on.push((name, source(camera)?)),
            Ok(_) => {}
            Err(Failed::Lost(error)) => return Err(error),
            Err(Failed::Refused(why) | Failed::Nonsense(why)) => {
                found.unknown = Some(format!("{MODE} cannot be read ({why}), expected On"))
            }
        }
        return Ok(found);
    }
    let before = match camera.text(SELECTOR) {
        Ok(before) => before,
        Err(Failed::Lost(error)) => return Err(error),
        Err(Failed::Refused(why) | Failed::Nonsense(why)) => {
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

/// Whether all entries of the selector have one mode: what is switched off at one of them is off at the others. The modes
/// are left as they were.
fn is_one_mode(camera: &dyn Features, found: &TriggersOn, selected: &str) -> Result<bool, CameraError> {
    let Some((other, _)) = found.on.iter().find(|(entry, _)| entry != selected) else { return Ok(false) };
    let Some((mine, _)) = found.on.iter().find(|(entry, _)| entry == selected) else { return Ok(false) };
    let mode = camera.feature(MODE);
    let entry = |names: &[&str]| mode.as_ref().and_then(|mode| mode.entry(names).map(str::to_owned));
    let (Some(on), Some(off)) = (entry(&ON), entry(&OFF)) else { return Ok(false) };
    if selected_mode(camera, other)?.is_none() || answered(camera.set_text(MODE, &off))?.is_none() {
        return Ok(false);
    }
    let one = selected_mode(camera, mine)?.is_some_and(|mode| !is_on(&mode));
    // Back to what it was: one for all from the trigger that is meant, else that of the other.
    if !one {
        answered(camera.set_text(SELECTOR, other))?;
    }
    answered(camera.set_text(MODE, &on))?;
    Ok(one)
}

/// The mode at an entry; `None` where it cannot be selected or read.
fn selected_mode(camera: &dyn Features, entry: &str) -> Result<Option<String>, CameraError> {
    answered(camera.set_text(SELECTOR, entry).and_then(|()| camera.text(MODE)))
}

fn source(camera: &dyn Features) -> Result<Option<String>, CameraError> {
    answered(camera.text("TriggerSource"))
}

const ON: [&str; 4] = ["On", "True", "Enabled", "Enable"];
const OFF: [&str; 4] = ["Off", "False", "Disabled", "Disable"];

fn is_on(mode: &str) -> bool {
    ON.iter().any(|on| plain(on) == plain(mode))
}
