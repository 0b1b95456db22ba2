// SPDX-License-Identifier: MIT OR Apache-2.0
//! Verifies by a camera's features that it sends what a session records, independent of the node file.

use super::contract::FrameContract;
use super::error::CameraError;
use super::features::{Failed, Features, answered, value_of};
use super::profile::{FRAME_TRIGGERS, Wishes, starts_a_frame, uneven_rows};
use super::triggers::TriggersOn;
use crate::config::{FeatureValue, Mosaic, Pixel};
use std::fmt::Display;

/// Most bytes of chunks behind an image; no camera appends as many.
const CHUNKS_MAX: usize = 1 << 20;

/// Features that make values of two bytes begin with the upper byte.
const UPPER_FIRST: [&str; 3] = ["GevSCPSBigEndian", "pgrPixelBigEndian", "DeviceStreamChannelEndianness"];
/// The register of the packet size, and its bit that makes values of two bytes begin with the upper byte.
const PACKET_SIZE: (u64, u32) = (0x0d04, 0x2000_0000);

/// The contract that the camera's frames must keep, or all differences from the requirements, each with its remedy.
/// `format` is the chosen entry of PixelFormat with its meaning; none: it is left to settings. `triggers` are those
/// that are on.
pub fn verify(
    camera: &dyn Features,
    wanted: &Wishes,
    format: Option<&(String, Pixel)>,
    triggers: &TriggersOn,
) -> Result<FrameContract, CameraError> {
    let mut check = Check { camera, problems: Vec::new() };
    let pixel = check.pixel(format, wanted.size.0)?;
    let (width, height) = (wanted.size.0 * pixel.step(), wanted.size.1 * pixel.step());
    let remedy = "set no other in `settings`, or correct the rig file";
    check.expect("Width", camera.integer("Width"), &(width as i64), remedy)?;
    check.expect("Height", camera.integer("Height"), &(height as i64), remedy)?;
    let remedy = "switch off what it appends to its images (chunks, padding of rows), by its own feature in `settings`";
    let chunk_room = check.payload(pixel.bytes(width * height), remedy)?;
    if wanted.triggered {
        const MODE: &str = "AcquisitionMode";
        if camera.has(MODE) {
            check.expect(MODE, camera.text(MODE), &"Continuous".to_owned(), "set no other in `settings`")?;
        }
        // A camera whose trigger is set up by features of its own is checked by its silence before the start, and by
        // the rhythm of the warm-up.
        if camera.has("TriggerMode") || !wanted.left_to_settings("trigger_line") {
            check.one_trigger(triggers);
        }
    }
    let offset = (check.offset("OffsetX")?, check.offset("OffsetY")?);
    let place = match pixel {
        Pixel::Bayer8(mosaic) => {
            if offset.0 % 2 + offset.1 % 2 > 0 {
                check.problems.push(format!(
                    "OffsetX is {} and OffsetY is {}, expected even ones: some cameras name the colours as if they \
                     were",
                    offset.0, offset.1
                ));
            }
            mosaic.place(wanted.channel)
        }
        _ => (0, 0),
    };
    if !check.problems.is_empty() {
        return Err(CameraError::SetUp { problems: check.problems });
    }
    Ok(FrameContract { pixel, size: wanted.size, place, offset, chunk_room })
}

struct Check<'a> {
    camera: &'a dyn Features,
    problems: Vec<String>,
}

impl Check<'_> {
    /// The value that was read; that it could not be read is a problem of its own.
    fn found<T>(
        &mut self,
        feature: &str,
        read: Result<T, Failed>,
        expected: &str,
    ) -> Result<Option<T>, CameraError> {
        let found = match read {
            Ok(value) => return Ok(Some(value)),
            Err(Failed::Lost(error)) => return Err(error),
            Err(Failed::Refused(why)) => format!("cannot be read ({why})"),
            Err(Failed::Nonsense(what)) => format!("is {what}"),
        };
        self.problems.push(format!("{feature} {found}, expected {expected}"));
        Ok(None)
    }

    /// Records a problem where a feature differs from the expected value.
    fn expect<T: PartialEq + Display>(
        &mut self,
        feature: &str,
        read: Result<T, Failed>,
        expected: &T,
        remedy: &str,
    ) -> Result<(), CameraError> {
        let found = self.found(feature, read, &expected.to_string())?;
        if let Some(found) = found.filter(|found| found != expected) {
            self.problems.push(format!("{feature} is {found}, expected {expected}: {remedy}"));
        }
        Ok(())
    }

    /// The camera's pixel: the format that was set, or any grey where it is left to settings.
    fn pixel(&mut self, format: Option<&(String, Pixel)>, width: usize) -> Result<Pixel, CameraError> {
        const NAME: &str = "PixelFormat";
        let pixel = match format {
            // The first colour of the mosaic depends on where the image begins, so the camera's own name is read.
            Some((entry, Pixel::Bayer8(_))) => {
                let found = self.found(NAME, self.camera.text(NAME), entry)?.unwrap_or_default();
                let known = Mosaic::ALL.map(Pixel::Bayer8).into_iter().find(|pixel| pixel.name() == found);
                if known.is_none() {
                    self.problems.push(format!(
                        "{NAME} is {found}, expected {entry}: set pixel = \"bayer8\", and set no other in `settings`"
                    ));
                }
                known.unwrap_or_default()
            }
            Some((entry, pixel)) => {
                let remedy = format!("set pixel = {:?}, and set no other in `settings`", pixel.word());
                self.expect(NAME, self.camera.text(NAME), entry, &remedy)?;
                *pixel
            }
            None => {
                let all = Pixel::GREY.map(Pixel::name).join(", ");
                let expected = format!("one of {all}");
                let Some(found) = self.found(NAME, self.camera.text(NAME), &expected)? else {
                    return Ok(Pixel::default());
                };
                let Some(pixel) = Pixel::GREY.into_iter().find(|pixel| pixel.name() == found) else {
                    let remedy = "set pixel = \"mono8\", and set no other in `settings`";
                    self.problems.push(format!("{NAME} is {found}, expected {expected}: {remedy}"));
                    return Ok(Pixel::default());
                };
                if !width.is_multiple_of(pixel.columns_step()) {
                    self.problems.push(uneven_rows(pixel, width));
                }
                pixel
            }
        };
        if pixel.bits() == 16
            && let Some(why) = self.upper_first()?
        {
            self.problems.push(format!(
                "{NAME} is {}, and the camera sends the upper byte of each value first ({why}), expected the lower: \
                 switch that off in `settings`, or set pixel to a format of 8 bits or a packed one",
                pixel.name()
            ));
        }
        Ok(pixel)
    }

    /// The feature or register that makes values of two bytes begin with the upper byte, where there is one.
    fn upper_first(&self) -> Result<Option<&'static str>, CameraError> {
        for feature in UPPER_FIRST {
            if let Some(value) = value_of(self.camera, feature)?
                && ["true", "1", "Big", "On"].contains(&value.to_string().as_str())
            {
                return Ok(Some(feature));
            }
        }
        let (register, bit) = PACKET_SIZE;
        let has = self.camera.has_registers();
        let bits = if has { answered(self.camera.register(register))? } else { None };
        Ok(bits.filter(|bits| bits & bit != 0).map(|_| "register 0x0d04"))
    }

    /// Room for chunks behind the image, bytes: 0 unless chunks cannot be switched off.
    fn payload(&mut self, image: usize, remedy: &str) -> Result<usize, CameraError> {
        const NAME: &str = "PayloadSize";
        const CHUNKS: &str = "ChunkModeActive";
        let found = self.found(NAME, self.camera.integer(NAME), &image.to_string())?;
        let Some(found) = found.filter(|found| usize::try_from(*found) != Ok(image)) else { return Ok(0) };
        let room = usize::try_from(found).ok().and_then(|found| found.checked_sub(image));
        let is_on = value_of(self.camera, CHUNKS)? == Some(FeatureValue::Flag(true));
        if let Some(room) = room.filter(|room| is_on && *room <= CHUNKS_MAX) {
            return Ok(room);
        }
        self.problems.push(format!("{NAME} is {found}, expected {image}: {remedy}"));
        Ok(0)
    }

    /// Offset of the image on the sensor; cameras without this feature send the whole sensor.
    fn offset(&mut self, feature: &str) -> Result<usize, CameraError> {
        if !self.camera.has(feature) {
            return Ok(0);
        }
        let found = self.found(feature, self.camera.integer(feature), "a number")?;
        Ok(found.and_then(|offset| usize::try_from(offset).ok()).unwrap_or(0))
    }

    /// Exactly one trigger must be on, and it must start a frame by a wire.
    fn one_trigger(&mut self, triggers: &TriggersOn) {
        let remedy = "set trigger_line, and no trigger in `settings`";
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
                "TriggerSource of {selector} is Software, expected the line of the HSU: set trigger_line"
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
