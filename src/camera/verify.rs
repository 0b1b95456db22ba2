// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether a camera, as it is set now, sends what a session records: asked of its features, whatever a node file sets.

use super::CameraError;
use super::contract::{FrameContract, MONO8};
use super::features::{Failed, Features};
use super::profile::{FRAME_TRIGGERS, Wishes, starts_a_frame};
use super::triggers::TriggersOn;

/// The contract that its frames must keep, or everything in which it differs from what is wanted, each with its remedy.
/// `mono8` is what the camera calls Mono8, `triggers` are those that are on.
pub fn verify(
    camera: &dyn Features,
    wanted: &Wishes,
    mono8: Option<&str>,
    triggers: &TriggersOn,
) -> Result<FrameContract, CameraError> {
    let mut check = Check { camera, problems: Vec::new() };
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
            check.one_trigger(triggers);
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

    /// Exactly one trigger must be on, and start a frame by a wire.
    fn one_trigger(&mut self, triggers: &TriggersOn) {
        let remedy = "say trigger_line, and set no trigger in `settings`";
        if let Some(unknown) = &triggers.unknown {
            return self.problems.push(unknown.clone());
        }
        match triggers.on.as_slice() {
            [] => self.problems.push(format!("TriggerMode is Off, expected On: {remedy}")),
            [(selector, _)] if !starts_a_frame(selector, triggers.alone) => self.problems.push(format!(
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
    }
}
