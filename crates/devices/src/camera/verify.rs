// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether a camera, as it is set now, sends what a session records: asked of its features, whatever a node file sets.

use super::CameraError;
use super::contract::FrameContract;
use super::features::{Failed, Features, answered};
use super::profile::{FRAME_TRIGGERS, Wishes, starts_a_frame, uneven_rows};
use super::triggers::TriggersOn;
use crate::config::{FeatureValue, Mosaic, Pixel};

/// No camera appends more, bytes.
const CHUNKS_MAX: usize = 1 << 20;

/// Features that have values of two bytes begin with the upper one.
const UPPER_FIRST: [&str; 3] = ["GevSCPSBigEndian", "pgrPixelBigEndian", "DeviceStreamChannelEndianness"];
/// The register of the packet size, and the bit in it that does.
const PACKET_SIZE: (u64, u32) = (0x0d04, 0x2000_0000);

/// The contract that its frames must keep, or everything in which it differs from what is wanted, each with its remedy.
/// `format` is the entry of PixelFormat that was set and what it is; none: settings stand for it. `triggers` are those
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
    check.integer("Width", width, remedy)?;
    check.integer("Height", height, remedy)?;
    let remedy = "switch off what it appends to its images (chunks, padding of rows), by its own feature in `settings`";
    let chunk_room = check.payload(pixel.bytes(width * height), remedy)?;
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
    let place = match pixel {
        Pixel::Bayer8(mosaic) => {
            if offset.0 % 2 + offset.1 % 2 > 0 {
                check.problems.push(format!(
                    "OffsetX is {} and OffsetY is {}, expected even ones: some cameras name the colours as if they were",
                    offset.0, offset.1
                ));
            }
            mosaic.place(wanted.channel)
        }
        _ => (0, 0),
    };
    match check.problems.is_empty() {
        true => Ok(FrameContract { pixel, size: wanted.size, place, offset, chunk_room }),
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

    /// What a pixel is: the format that was set, or any of grey where settings stand for it.
    fn pixel(&mut self, format: Option<&(String, Pixel)>, width: usize) -> Result<Pixel, CameraError> {
        const NAME: &str = "PixelFormat";
        let pixel = match format {
            // What its mosaic begins with follows from where its image does: the camera's own name for it holds.
            Some((entry, Pixel::Bayer8(_))) => {
                let found = self.found(NAME, self.camera.text(NAME), entry)?.unwrap_or_default();
                let known = Mosaic::ALL.map(Pixel::Bayer8).into_iter().find(|pixel| pixel.name() == found);
                if known.is_none() {
                    self.problems.push(format!(
                        "{NAME} is {found}, expected {entry}: say pixel = \"bayer8\", and set no other in `settings`"
                    ));
                }
                known.unwrap_or_default()
            }
            Some((entry, pixel)) => {
                let remedy = format!("say pixel = {:?}, and set no other in `settings`", pixel.word());
                self.text(NAME, entry, &remedy)?;
                *pixel
            }
            None => {
                let all = Pixel::GREY.map(Pixel::name).join(", ");
                let expected = format!("one of {all}");
                let Some(found) = self.found(NAME, self.camera.text(NAME), &expected)? else {
                    return Ok(Pixel::default());
                };
                let Some(pixel) = Pixel::GREY.into_iter().find(|pixel| pixel.name() == found) else {
                    let remedy = "say pixel = \"mono8\", and set no other in `settings`";
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
                 switch that off in `settings`, or name a format of 8 bits or a packed one (pixel)",
                pixel.name()
            ));
        }
        Ok(pixel)
    }

    /// What has values of two bytes begin with the upper one, where something does.
    fn upper_first(&self) -> Result<Option<&'static str>, CameraError> {
        for feature in UPPER_FIRST.into_iter().filter(|feature| self.camera.is_available(feature)) {
            if let Some(value) = answered(self.camera.read(feature))?
                && ["true", "1", "Big", "On"].contains(&value.to_string().as_str())
            {
                return Ok(Some(feature));
            }
        }
        let (register, bit) = PACKET_SIZE;
        let bits = match self.camera.has_registers() {
            true => answered(self.camera.register(register))?,
            false => None,
        };
        Ok(bits.filter(|bits| bits & bit != 0).map(|_| "register 0x0d04"))
    }

    fn integer(&mut self, feature: &str, expected: usize, remedy: &str) -> Result<(), CameraError> {
        let found = self.found(feature, self.camera.integer(feature), &expected.to_string())?;
        if let Some(found) = found.filter(|found| usize::try_from(*found) != Ok(expected)) {
            self.problems.push(format!("{feature} is {found}, expected {expected}: {remedy}"));
        }
        Ok(())
    }

    /// Room for chunks behind the image, bytes: none, unless they are on and stay on.
    fn payload(&mut self, image: usize, remedy: &str) -> Result<usize, CameraError> {
        const NAME: &str = "PayloadSize";
        const CHUNKS: &str = "ChunkModeActive";
        let found = self.found(NAME, self.camera.integer(NAME), &image.to_string())?;
        let Some(found) = found.filter(|found| usize::try_from(*found) != Ok(image)) else { return Ok(0) };
        let room = usize::try_from(found).ok().and_then(|found| found.checked_sub(image));
        let is_on = match self.camera.is_available(CHUNKS) {
            true => {
                answered(self.camera.read(CHUNKS))?.is_some_and(|value| value == FeatureValue::Flag(true))
            }
            false => false,
        };
        if let Some(room) = room.filter(|room| is_on && *room <= CHUNKS_MAX) {
            return Ok(room);
        }
        self.problems.push(format!("{NAME} is {found}, expected {image}: {remedy}"));
        Ok(0)
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
