// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether a camera, as it is set now, sends what a session records: asked of its features, whatever a node file sets.

use super::CameraError;
use super::contract::{FrameContract, MONO8};
use super::description::plain;
use super::features::{Failed, Features, answered};
use super::profile::{FRAME_TRIGGERS, Wishes, starts_a_frame};

/// The contract that its frames must keep, or everything in which it differs from what is wanted, each with its remedy.
/// `mono8` is what the camera calls Mono8.
pub fn verify(
    camera: &dyn Features,
    wanted: &Wishes,
    mono8: Option<&str>,
) -> Result<FrameContract, CameraError> {
    let mut check = Check { camera, problems: Vec::new(), alone: false };
    let (width, height) = wanted.size;
    check.text(
        "PixelFormat",
        mono8.unwrap_or(MONO8.1),
        "say pixel = \"mono8\", and set no other in `settings`",
    )?;
    let remedy = "set no other in `settings`, or correct the rig file";
    check.integer("Width", width, remedy)?;
    check.integer("Height", height, remedy)?;
    let remedy = "switch off what it appends to its images (chunks, padding of rows), by its own feature in `settings`";
    check.integer("PayloadSize", width * height, remedy)?;
    if wanted.triggered {
        if camera.has("AcquisitionMode") {
            check.text("AcquisitionMode", "Continuous", "set no other in `settings`")?;
        }
        // A camera whose trigger is set up by features of its own is told by its silence before the start, and by
        // the rhythm of the warm-up.
        if camera.has("TriggerMode") || !wanted.left_to_settings("trigger_line") {
            check.triggers()?;
        }
    }
    let offset = (check.offset("OffsetX")?, check.offset("OffsetY")?);
    match check.problems.is_empty() {
        true => Ok(FrameContract { size: wanted.size, offset }),
        false => Err(CameraError::SetUp { problems: check.problems }),
    }
}

struct Check<'a> {
    camera: &'a dyn Features,
    problems: Vec<String>,
    /// There is one trigger alone.
    alone: bool,
}

impl Check<'_> {
    /// What was read; that it could not be read is a problem of its own.
    fn found<T>(
        &mut self,
        feature: &str,
        read: Result<T, Failed>,
        expected: &str,
    ) -> Result<Option<T>, CameraError> {
        match read {
            Ok(value) => Ok(Some(value)),
            Err(Failed::Lost(error)) => Err(error),
            Err(Failed::Refused(why)) => {
                self.problems.push(format!("{feature} cannot be read ({why}), expected {expected}"));
                Ok(None)
            }
            Err(Failed::Nonsense(what)) => {
                self.problems.push(format!("{feature} is {what}, expected {expected}"));
                Ok(None)
            }
        }
    }

    fn text(&mut self, feature: &str, expected: &str, remedy: &str) -> Result<(), CameraError> {
        let found = self.found(feature, self.camera.text(feature), expected)?;
        if let Some(found) = found.filter(|found| found != expected) {
            self.problems.push(format!("{feature} is {found}, expected {expected}: {remedy}"));
        }
        Ok(())
    }

    fn integer(&mut self, feature: &str, expected: usize, remedy: &str) -> Result<(), CameraError> {
        let found = self.found(feature, self.camera.integer(feature), &expected.to_string())?;
        if let Some(found) = found.filter(|found| usize::try_from(*found) != Ok(expected)) {
            self.problems.push(format!("{feature} is {found}, expected {expected}: {remedy}"));
        }
        Ok(())
    }

    /// Cameras without this feature send the whole sensor.
    fn offset(&mut self, feature: &str) -> Result<usize, CameraError> {
        if !self.camera.has(feature) {
            return Ok(0);
        }
        let found = self.found(feature, self.camera.integer(feature), "a number")?;
        Ok(found.and_then(|offset| usize::try_from(offset).ok()).unwrap_or(0))
    }

    /// Exactly one trigger must be on, and start a frame by a wire. The selector is left as it was.
    fn triggers(&mut self) -> Result<(), CameraError> {
        const SELECTOR: &str = "TriggerSelector";
        let entries = self.camera.entries(SELECTOR);
        self.alone = entries.len() < 2;
        // A selector that can only be read says which trigger there is.
        let fixed = self.camera.feature(SELECTOR).is_some_and(|selector| !selector.is_writable());
        if self.alone || fixed {
            let found = self.found("TriggerMode", self.camera.text("TriggerMode"), "On")?;
            let selected = if fixed { answered(self.camera.text(SELECTOR))? } else { None };
            let selected = selected.or_else(|| entries.first().cloned());
            let selector = selected.as_deref().unwrap_or(FRAME_TRIGGERS[0]);
            return match found.as_deref() {
                None => Ok(()),
                Some(mode) if is_on(mode) => self.one_trigger(&[(selector.to_owned(), self.source()?)]),
                Some(_) => self.one_trigger(&[]),
            };
        }
        let before = self.found(SELECTOR, self.camera.text(SELECTOR), "a trigger's name")?;
        let mut on = Vec::new();
        for entry in entries {
            // An entry that cannot be selected, or has no mode of its own, is no trigger that could be on.
            match self.camera.set_text(SELECTOR, &entry).and_then(|()| self.camera.text("TriggerMode")) {
                Ok(mode) if is_on(&mode) => on.push((entry, self.source()?)),
                Ok(_) | Err(Failed::Refused(_) | Failed::Nonsense(_)) => {}
                Err(Failed::Lost(error)) => return Err(error),
            }
        }
        if let Some(before) = before
            && let Err(Failed::Lost(error)) = self.camera.set_text(SELECTOR, &before)
        {
            return Err(error);
        }
        self.one_trigger(&on)
    }

    fn source(&self) -> Result<Option<String>, CameraError> {
        match self.camera.text("TriggerSource") {
            Ok(source) => Ok(Some(source)),
            Err(Failed::Refused(_) | Failed::Nonsense(_)) => Ok(None),
            Err(Failed::Lost(error)) => Err(error),
        }
    }

    fn one_trigger(&mut self, on: &[(String, Option<String>)]) -> Result<(), CameraError> {
        let remedy = "say trigger_line, and set no trigger in `settings`";
        match on {
            [] => self.problems.push(format!("TriggerMode is Off, expected On: {remedy}")),
            [(selector, _)] if !starts_a_frame(selector, self.alone) => self.problems.push(format!(
                "TriggerMode is On for {selector}, expected for {}: {remedy}",
                FRAME_TRIGGERS[..3].join(" or ")
            )),
            [(selector, Some(source))] if source == "Software" => self.problems.push(format!(
                "TriggerSource of {selector} is Software, expected the line of the HSU: say trigger_line"
            )),
            [_] => {}
            several => {
                let names: Vec<&str> = several.iter().map(|(selector, _)| selector.as_str()).collect();
                self.problems.push(format!(
                    "TriggerMode is On for {}, expected for one alone: {remedy}",
                    names.join(" and ")
                ));
            }
        }
        Ok(())
    }
}

fn is_on(mode: &str) -> bool {
    ["on", "true", "enabled", "enable"].contains(&plain(mode).as_str())
}
