// SPDX-License-Identifier: MIT OR Apache-2.0
//! A known beginning: the acquisition is stopped and the settings of delivery are loaded. Not every camera says when it has
//! them: the register of some keeps the number of the set for ever.

use crate::camera::CameraError;
use crate::camera::description::list;
use crate::camera::features::{Failed, Features, answered, value_text};
use crate::camera::profile::{self, Amount, Wishes};
use crate::camera::state::State;
use crate::config::FeatureValue;
use std::time::{Duration, Instant};

/// A camera takes its settings of delivery within this.
const PATIENCE: Duration = Duration::from_secs(5);
/// One that does not say when it has them is given so long: what is set before that would be lost.
const SETTLES: Duration = Duration::from_millis(700);
/// What is the same after so long is taken for settled.
const STILL: Duration = Duration::from_millis(200);

/// Ends an acquisition that the last user left, and loads the settings of delivery. What an operator should know of it.
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
        format!(
            "{command} of {value} was refused ({why}): what the last user set is kept where nothing here sets it"
        )
    };
    match camera.write(&select.feature, value) {
        Ok(()) => {}
        Err(Failed::Lost(error)) => return Err(error),
        Err(Failed::Refused(why) | Failed::Nonsense(why)) => {
            return Ok(vec![kept(&format!("{} cannot be set: {why}", select.feature))]);
        }
    }
    // A register that says "not done" before anything was begun never says "done".
    let done = camera.is_done(command);
    let tells = done != Some(false);
    let before = match done {
        Some(_) => matters(camera, wishes)?,
        None => State::new(),
    };
    let status_tells = !says_in_progress(camera)?;
    match camera.write(command, &FeatureValue::Flag(true)) {
        Ok(()) => {}
        Err(Failed::Lost(error)) => return Err(error),
        Err(Failed::Refused(why) | Failed::Nonsense(why)) => return Ok(vec![kept(&why)]),
    }
    let load = Load { camera, command, status_tells, begun: Instant::now() };
    if tells && load.is_told()? {
        return Ok(Vec::new());
    }
    // The end cannot be read: what it was to change is read instead, until nothing changes any more.
    let Some(now) = load.still(wishes)? else {
        problems.push(format!(
            "{command} is not done after {} s: expected settings that stay, found some that change; wait until the camera \
             has started, or restart it, and look whether it is used by another program",
            PATIENCE.as_secs()
        ));
        return Ok(Vec::new());
    };
    let changed: Vec<String> = before
        .iter()
        .filter(|(name, value)| now.get(*name).is_some_and(|now| now != *value))
        .map(|(name, _)| name.clone())
        .collect();
    let changed = match changed.is_empty() {
        true => "nothing that matters".to_owned(),
        false => list(&changed),
    };
    Ok(vec![format!(
        "{command} of {value} never says that it is done; it changed {changed}, and what matters is set and read after it"
    )])
}

struct Load<'a> {
    camera: &'a dyn Features,
    command: &'static str,
    /// Its status did not say "in progress" before anything was begun.
    status_tells: bool,
    begun: Instant,
}

impl Load<'_> {
    /// Whether the camera says that it is done, within its time; where it says nothing it is given time to settle. Some
    /// refuse everything while they load.
    fn is_told(&self) -> Result<bool, CameraError> {
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

    /// Whether it can be seen that it is loading.
    fn is_busy(&self) -> Result<bool, CameraError> {
        let mute = self.camera.has("Width") && answered(self.camera.read("Width"))?.is_none();
        Ok(mute || self.status_tells && says_in_progress(self.camera)?)
    }

    /// What matters, once it does not change any more; `None` where it goes on changing.
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

/// Whether the camera's own status says that it is loading.
fn says_in_progress(camera: &dyn Features) -> Result<bool, CameraError> {
    const STATUS: &str = "UserSetLoadStatus";
    let status = if camera.has(STATUS) { answered(camera.read(STATUS))? } else { None };
    Ok(matches!(status, Some(FeatureValue::Text(text)) if text == "InProgress"))
}

/// What a session needs to be so, as it is now.
fn matters(camera: &dyn Features, wishes: &Wishes) -> Result<State, CameraError> {
    let (musts, _) = profile::must_be(camera, wishes);
    let plan = profile::resolve(camera, wishes);
    let names =
        musts.into_iter().map(|must| must.feature).chain(plan.writes.into_iter().map(|write| write.feature));
    let mut state = State::new();
    for name in names.filter(|name| !name.ends_with("Selector")) {
        if camera.is_available(&name)
            && let Some(value) = answered(camera.read(&name))?
        {
            state.insert(name, value_text(&value));
        }
    }
    Ok(state)
}
