// SPDX-License-Identifier: MIT OR Apache-2.0
//! Exposure and gain of the cameras of a head, set between sessions: as the node file's words, until they are set
//! again or the node is started anew.

use super::{Devices, OpenCamera, PreparedCamera};
use crate::base::{Exit, Fault};
use crate::camera::AppliedSetting;
use crate::config::Head;
use crate::control::request::ExposureRequest;
use crate::control::status::{CameraExposure, ExposureNow, ExposureSet};

/// The bounds of the node file; microseconds and decibels.
const LEAST_US: f64 = 0.1;
const MOST_DB: f64 = 100.0;

/// First characters of the features that are a camera's exposure or gain.
const EXPOSURE_OR_GAIN: [&str; 6] =
    ["Exposure", "Shutter", "IntegrationTime", "Gain", "AnalogGain", "DigitalGain"];

impl Devices {
    /// Sets exposure and gain of this node's cameras of some heads: all of them, or none. Each is set up as for a
    /// session, and read back.
    ///
    /// # Errors
    /// [`Exit::Usage`]: the rig or a camera does not allow the request; [`Exit::Device`]: a camera fails.
    pub fn expose(&mut self, request: &ExposureRequest) -> Result<ExposureSet, Fault> {
        self.check(request)?;
        let is_asked =
            |slot: &OpenCamera| self.head_of(slot).is_some_and(|head| request.names(head.id.as_str()));
        let places: Vec<usize> = (0..self.slots.len()).filter(|i| is_asked(&self.slots[*i])).collect();
        let before: Vec<_> = places.iter().map(|i| self.slots[*i].wishes.words.clone()).collect();
        let mut faults = Vec::new();
        let mut set = Vec::new();
        for &i in &places {
            let words = &mut self.slots[i].wishes.words;
            words.exposure_us = request.exposure_us.or(words.exposure_us);
            words.gain_db = request.gain_db.or(words.gain_db);
            match self.prepare_camera(i) {
                Ok(camera) => set.push((i, camera)),
                Err(fault) => faults.push(fault.message),
            }
        }
        if faults.is_empty() {
            let cameras = set.into_iter().map(|(i, camera)| self.exposed(i, camera)).collect();
            return Ok(ExposureSet { cameras });
        }
        // A camera that takes its old settings works: only the request does not fit it.
        let mut exit = Exit::Usage;
        for (&i, words) in places.iter().zip(before) {
            self.slots[i].wishes.words = words;
            if self.prepare_camera(i).is_err() {
                exit = Exit::Device;
            }
        }
        let message = format!("nothing was changed: {}", faults.join("\n"));
        Err(Fault::new(exit, message))
    }

    /// Whether the rig and the node file allow it.
    fn check(&self, request: &ExposureRequest) -> Result<(), Fault> {
        let refused = |message: String| Err(Fault::new(Exit::Usage, message));
        if request.exposure_us.is_none() && request.gain_db.is_none() {
            return refused("expected exposure_us or gain_db, found neither".to_owned());
        }
        let known = &self.config.rig.heads;
        let names: Vec<&str> = known.iter().map(|head| head.id.as_str()).collect();
        if request.heads.is_empty() {
            return refused(format!("expected heads of the rig ({}), found none", names.join(", ")));
        }
        if let Some(unknown) = request.heads.iter().find(|head| !names.contains(&head.as_str())) {
            return refused(format!("expected heads of the rig ({}), found {unknown:?}", names.join(", ")));
        }
        for head in known.iter().filter(|head| request.names(head.id.as_str())) {
            let most = self.most_us(head);
            if let Some(us) = request.exposure_us.filter(|us| !(LEAST_US..=most).contains(us)) {
                return refused(format!(
                    "head {}: expected an exposure from {LEAST_US} to {most:.1} us, which ends within the trigger \
                     period, found {us}",
                    head.id
                ));
            }
        }
        if let Some(db) = request.gain_db.filter(|db| !(0.0..=MOST_DB).contains(db)) {
            return refused(format!("expected a gain from 0 to {MOST_DB} dB, found {db}"));
        }
        for slot in &self.slots {
            let is_asked = self.head_of(slot).is_some_and(|head| request.names(head.id.as_str()));
            for (word, said) in [("exposure_us", request.exposure_us), ("gain_db", request.gain_db)] {
                if is_asked && said.is_some() && slot.wishes.left_to_settings(word) {
                    return refused(format!(
                        "camera {}: the node file leaves {word} to raw settings (left_to_settings): change it there",
                        slot.config.id
                    ));
                }
            }
        }
        Ok(())
    }

    /// The longest exposure that ends, after the delay of its head, within the trigger period, us.
    fn most_us(&self, head: &Head) -> f64 {
        // The unit wants some time left.
        (head.exposure_limit_us(self.config.rig.trigger_rate_hz) - 1.0).max(LEAST_US)
    }

    fn head_of(&self, slot: &OpenCamera) -> Option<&Head> {
        let of = |head: &&Head| head.cameras.iter().any(|camera| camera.id == slot.config.id);
        self.config.rig.heads.iter().find(of)
    }

    fn exposed(&self, i: usize, camera: PreparedCamera) -> CameraExposure {
        let wishes = &self.slots[i].wishes;
        let is_theirs =
            |setting: &&AppliedSetting| EXPOSURE_OR_GAIN.iter().any(|name| setting.feature.starts_with(name));
        CameraExposure {
            id: camera.id,
            exposure_us: wishes.exposure_us(),
            gain_db: wishes.words.gain_db.unwrap_or(0.0),
            taken: camera.settings.iter().filter(is_theirs).cloned().collect(),
            told: camera.told,
            settings: camera.settings,
        }
    }

    /// The exposure and gain that a camera has to use now, for the status.
    pub(super) fn exposure_now(&self, slot: &OpenCamera) -> Option<ExposureNow> {
        let (head, wishes) = (self.head_of(slot)?, &slot.wishes);
        let left = |word| wishes.left_to_settings(word);
        Some(ExposureNow {
            head: head.id.to_string(),
            exposure_us: (!left("exposure_us")).then(|| wishes.exposure_us()),
            gain_db: (!left("gain_db")).then(|| wishes.words.gain_db.unwrap_or(0.0)),
            most_us: self.most_us(head),
            differs: wishes.words != slot.config.words,
        })
    }
}
