// SPDX-License-Identifier: MIT OR Apache-2.0
//! The PTP status of a camera while a session runs: recorded, and passed on to the scheduler of actions.

use crate::base::ids::CameraId;
use crate::camera::{Camera, CameraError};
use crate::hsu::action::ActionTally;

/// Where PTP is on, a camera's status is looked at from the beginning of a session to its end.
pub(super) struct PtpWatch {
    camera: CameraId,
    actions: Option<ActionTally>,
    /// Its last status; `None` where PTP is off.
    last: Option<String>,
}

impl PtpWatch {
    /// `actions` are the commands that rest on the camera's clock, if any do.
    pub(super) fn new(camera: CameraId, actions: Option<ActionTally>) -> Self {
        Self { camera, actions, last: None }
    }

    /// The session begins. Gives the status, where PTP is on.
    pub(super) fn begin(&mut self, camera: &mut dyn Camera) -> Option<String> {
        let asked = self.unexposed();
        let status = camera.ptp_status().ok().flatten();
        self.last = status.filter(|status| !["Disabled", "Off"].contains(&status.as_str()));
        self.pass_on(asked);
        self.last.clone()
    }

    /// Reads it again. Gives the status where it is not as it was, and at the end in any case.
    ///
    /// # Errors
    /// The camera does not answer, or answers nonsense.
    pub(super) fn look(
        &mut self,
        camera: &mut dyn Camera,
        at_the_end: bool,
    ) -> Result<Option<String>, CameraError> {
        let Some(before) = &self.last else { return Ok(None) };
        let asked = self.unexposed();
        let status = camera.ptp_status()?.unwrap_or_else(|| "not told".to_owned());
        let noted = at_the_end || status != *before;
        self.last = Some(status.clone());
        self.pass_on(asked);
        Ok(noted.then_some(status))
    }

    /// The camera is lost, and its status with it.
    pub(super) fn lost(&self) {
        if let Some(actions) = &self.actions {
            actions.lost(&self.camera);
        }
    }

    fn unexposed(&self) -> i64 {
        self.actions.as_ref().map_or(i64::MIN, ActionTally::unexposed)
    }

    fn pass_on(&self, asked: i64) {
        if let Some((actions, status)) = self.actions.as_ref().zip(self.last.as_ref()) {
            actions.ptp(&self.camera, status, asked);
        }
    }
}
