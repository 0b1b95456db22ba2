// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether a camera, as it is set now, sends what a session records: asked of its features, whatever a node file sets.

use super::contract::{FrameContract, MONO8};
use super::features::{Failed, Features};
use super::{CameraError, Wanted};

/// Selectors of the triggers that start a single frame.
const FRAME_TRIGGERS: [&str; 3] = ["FrameStart", "ExposureStart", "FrameBurstStart"];

/// The contract that its frames must keep, or everything in which it differs from `wanted`, each with its remedy.
pub fn verify(camera: &dyn Features, wanted: &Wanted) -> Result<FrameContract, CameraError> {
    let mut check = Check { camera, problems: Vec::new() };
    let (width, height) = wanted.size;
    check.text("PixelFormat", MONO8.1)?;
    let set = |feature: &str, value: usize| format!("set [\"{feature}\", {value}], or correct the rig");
    check.integer("Width", width, &set("Width", width))?;
    check.integer("Height", height, &set("Height", height))?;
    let remedy =
        "switch off what it appends to its images (chunks, padding of rows): [\"ChunkModeActive\", false]";
    check.integer("PayloadSize", width * height, remedy)?;
    if wanted.triggered {
        if camera.has("AcquisitionMode") {
            check.text("AcquisitionMode", "Continuous")?;
        }
        check.triggers()?;
    }
    let offset = (check.offset("OffsetX")?, check.offset("OffsetY")?);
    match check.problems.is_empty() {
        true => Ok(FrameContract { size: wanted.size, offset }),
        false => Err(CameraError::Contract { problems: check.problems }),
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
        }
    }

    fn text(&mut self, feature: &str, expected: &str) -> Result<(), CameraError> {
        let found = self.found(feature, self.camera.text(feature), expected)?;
        if let Some(found) = found.filter(|found| found != expected) {
            self.problems.push(format!(
                "{feature} is {found}, expected {expected}: set [\"{feature}\", \"{expected}\"]"
            ));
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
        if entries.len() < 2 {
            let found = self.found("TriggerMode", self.camera.text("TriggerMode"), "On")?;
            let selector = entries.first().map_or(FRAME_TRIGGERS[0], String::as_str);
            return match found.as_deref() {
                None => Ok(()),
                Some("On") => self.one_trigger(&[(selector.to_owned(), self.source()?)]),
                Some(_) => self.one_trigger(&[]),
            };
        }
        let before = self.found(SELECTOR, self.camera.text(SELECTOR), "a trigger's name")?;
        let mut on = Vec::new();
        for entry in entries {
            // An entry that cannot be selected, or has no mode of its own, is no trigger that could be on.
            match self.camera.set_text(SELECTOR, &entry).and_then(|()| self.camera.text("TriggerMode")) {
                Ok(mode) if mode == "On" => on.push((entry, self.source()?)),
                Ok(_) | Err(Failed::Refused(_)) => {}
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
            Err(Failed::Refused(_)) => Ok(None),
            Err(Failed::Lost(error)) => Err(error),
        }
    }

    fn one_trigger(&mut self, on: &[(String, Option<String>)]) -> Result<(), CameraError> {
        let remedy =
            "set [\"TriggerMode\", \"On\"] behind its TriggerSelector, and \"Off\" behind every other";
        match on {
            [] => self.problems.push(format!("TriggerMode is Off, expected On: {remedy}")),
            [(selector, _)] if !FRAME_TRIGGERS.contains(&selector.as_str()) => self.problems.push(format!(
                "TriggerMode is On for {selector}, expected for {}: {remedy}",
                FRAME_TRIGGERS.join(" or ")
            )),
            [(selector, Some(source))] if source == "Software" => self.problems.push(format!(
                "TriggerSource of {selector} is Software, expected the line of the HSU: set [\"TriggerSource\", \"Line0\"] \
                 or as the line is called"
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
