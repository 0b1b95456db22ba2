// SPDX-License-Identifier: MIT OR Apache-2.0
//! A known beginning: the acquisition is stopped and the factory settings are loaded. Not every camera reports the
//! end of the load: the command register of some keeps the number of the user set for ever.

use super::values_of;
use crate::camera::description::list;
use crate::camera::error::CameraError;
use crate::camera::features::{Features, answered, or_reason};
use crate::camera::profile::{self, Amount, Wishes};
use crate::camera::settings::State;
use crate::config::FeatureValue;
use std::time::{Duration, Instant};

/// Longest time that a camera may take to load its factory settings.
const PATIENCE: Duration = Duration::from_secs(5);
/// Wait for a camera that does not report the end of the load: settings made before the end would be lost.
const SETTLES: Duration = Duration::from_millis(700);
/// Settings that stay the same for this long have settled.
const STILL: Duration = Duration::from_millis(200);

/// Stops an acquisition that the last user left running, and loads the factory settings. Gives remarks for the
/// operator.
pub fn known_state(
    camera: &dyn Features,
    wishes: &Wishes,
    problems: &mut Vec<String>,
) -> Result<Vec<String>, CameraError> {
    if camera.has("AcquisitionStop") {
        answered(camera.write("AcquisitionStop", &FeatureValue::Flag(true)))?;
    }
    let Some((select, command)) = profile::known_state(camera) else { return Ok(Vec::new()) };
    let Amount::Value(value) = &select.amount else { return Ok(Vec::new()) };
    let kept = |why: &str| {
        vec![format!(
            "{command} of {value} was refused ({why}): the last user's settings are kept where nothing here sets them"
        )]
    };
    if let Err(why) = or_reason(camera.write(&select.feature, value))? {
        return Ok(kept(&format!("{} cannot be set: {why}", select.feature)));
    }
    // A register that reads "not done" before the command was executed will never read "done".
    let done = camera.is_done(command);
    let before = if done.is_some() { matters(camera, wishes)? } else { State::new() };
    let has_status = !is_in_progress(camera)?;
    if let Err(why) = or_reason(camera.write(command, &FeatureValue::Flag(true)))? {
        return Ok(kept(&why));
    }
    let load = Load { camera, command, has_status, begun: Instant::now() };
    if done != Some(false) && load.is_done()? {
        return Ok(Vec::new());
    }
    // The end cannot be read: the settings that it changes are read instead, until nothing changes any more.
    let Some(now) = load.still(wishes)? else {
        problems.push(format!(
            "{command} is not done after {} s: expected settings that stay, found some that change; wait until the \
             camera \
             has started, or restart it, and check whether another program uses it",
            PATIENCE.as_secs()
        ));
        return Ok(Vec::new());
    };
    let differ = |(name, value): &(&String, &String)| now.get(*name).is_some_and(|now| now != *value);
    let changed: Vec<String> = before.iter().filter(differ).map(|(name, _)| name.clone()).collect();
    let changed = if changed.is_empty() { "nothing that matters".to_owned() } else { list(&changed) };
    Ok(vec![format!(
        "{command} of {value} never reports that it is done; it changed {changed}, and what matters is set and read \
         after it"
    )])
}

/// A load of the factory settings that has been started.
struct Load<'a> {
    camera: &'a dyn Features,
    command: &'static str,
    /// Whether the status can be trusted: it was not "in progress" before the load.
    has_status: bool,
    begun: Instant,
}

impl Load<'_> {
    /// Whether the camera reports the end in time. A camera that reports nothing gets time to settle. Some cameras
    /// refuse everything while they load.
    fn is_done(&self) -> Result<bool, CameraError> {
        if self.camera.is_done(self.command).is_none() {
            std::thread::sleep(SETTLES);
        }
        while self.begun.elapsed() < PATIENCE {
            match self.camera.is_done(self.command) {
                Some(true) => return Ok(true),
                None if !self.is_busy()? => return Ok(true),
                _ => std::thread::sleep(Duration::from_millis(20)),
            }
        }
        Ok(false)
    }

    /// Whether the camera visibly still loads.
    fn is_busy(&self) -> Result<bool, CameraError> {
        let mute = self.camera.has("Width") && answered(self.camera.read("Width"))?.is_none();
        Ok(mute || self.has_status && is_in_progress(self.camera)?)
    }

    /// The settings that matter, once they do not change any more; `None` where they go on changing.
    fn still(&self, wishes: &Wishes) -> Result<Option<State>, CameraError> {
        std::thread::sleep(SETTLES.saturating_sub(self.begun.elapsed()));
        let until = Instant::now() + PATIENCE;
        let mut last = matters(self.camera, wishes)?;
        loop {
            std::thread::sleep(STILL);
            let now = matters(self.camera, wishes)?;
            if now == last && !self.is_busy()? {
                return Ok(Some(now));
            }
            if Instant::now() >= until {
                return Ok(None);
            }
            last = now;
        }
    }
}

/// Whether the camera's load status is "in progress".
fn is_in_progress(camera: &dyn Features) -> Result<bool, CameraError> {
    const STATUS: &str = "UserSetLoadStatus";
    let status = if camera.has(STATUS) { answered(camera.read(STATUS))? } else { None };
    Ok(matches!(status, Some(FeatureValue::Text(text)) if text == "InProgress"))
}

/// The current values of all features that the set-up requires or writes.
fn matters(camera: &dyn Features, wishes: &Wishes) -> Result<State, CameraError> {
    let (musts, _) = profile::must_be(camera, wishes);
    let plan = profile::resolve(camera, wishes);
    let written = plan.writes.iter().map(|write| &write.feature);
    values_of(camera, musts.iter().map(|must| &must.feature).chain(written))
}
