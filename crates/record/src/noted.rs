// SPDX-License-Identifier: MIT OR Apache-2.0
//! What events of a recording state about its outcomes: the part of a verdict that is not counted from frames and gaps.

use super::layout::NodeEvent;
use super::simultaneous::NotSimultaneous;
use crate::base::ids::CameraId;

/// Kind of the events that name a camera of which the trigger of some frames rests on one source alone.
pub const UNCONFIRMED: &str = "identity_unconfirmed";
/// Kind of the events that name an outcome which was refused.
pub const REFUSED: &str = "refused";

/// Kind of the events that name the settings of a camera that changed while the session ran.
pub const SETTING_CHANGED: &str = "setting_changed";
/// Most changed settings that a verdict lists.
const CHANGED_MAX: usize = 16;

/// What events of a recording state about its outcomes.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Noted {
    pub refused: u64,
    pub unconfirmed: u64,
    /// Events of kind [`SETTING_CHANGED`], with their cameras.
    pub changed: Vec<String>,
    /// Exposures that were not at one time.
    pub not_simultaneous: NotSimultaneous,
}

impl Noted {
    /// Takes an event into account.
    pub fn note(&mut self, event: &NodeEvent) {
        self.refused += u64::from(event.kind == REFUSED);
        self.unconfirmed += u64::from(event.kind == UNCONFIRMED);
        self.not_simultaneous.note(event);
        if event.kind == SETTING_CHANGED && self.changed.len() < CHANGED_MAX {
            let camera = event.camera.as_ref().map_or("", CameraId::as_str);
            self.changed.push(format!("{camera}: {}", event.message));
        }
    }
}
