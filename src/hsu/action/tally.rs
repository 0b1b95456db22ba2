// SPDX-License-Identifier: MIT OR Apache-2.0
//! What became of the action commands, by camera: each is sent once, and acknowledged once at most.

use crate::base::ids::CameraId;
use crate::network::ActionStatus;
use std::collections::VecDeque;
use std::fmt;
use std::net::Ipv4Addr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Commands whose answer may still come.
const OUTSTANDING: usize = 256;

/// Counts of one camera.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CameraTally {
    /// Commands sent.
    pub sent: u64,
    /// Those that this host's network refused, or for which the cameras' clock was not known.
    pub unsent: u64,
    /// Those that the camera took in time.
    pub taken: u64,
    /// Those that it took after their time.
    pub late: u64,
    /// Those that it refused.
    pub refused: u64,
}

impl CameraTally {
    /// Those that it did not answer.
    pub fn unanswered(&self) -> u64 {
        self.sent.saturating_sub(self.taken + self.late + self.refused)
    }

    /// Whether each came in time.
    pub fn is_clean(&self) -> bool {
        self.taken == self.sent && self.unsent == 0
    }
}

impl fmt::Display for CameraTally {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { sent, unsent, taken, late, refused } = self;
        write!(
            f,
            "{sent} action commands sent, {taken} acknowledged, {late} late, {refused} refused, {} unanswered, {unsent} \
             not sent",
            self.unanswered()
        )
    }
}

#[derive(Debug)]
struct Camera {
    id: CameraId,
    address: Ipv4Addr,
    tally: CameraTally,
    outstanding: VecDeque<u16>,
}

/// Counts of all cameras, shared by who sends and who tells.
#[derive(Debug, Clone)]
pub struct ActionTally(Arc<Mutex<Vec<Camera>>>);

impl ActionTally {
    pub(super) fn new(cameras: &[(CameraId, Ipv4Addr)]) -> Self {
        let camera = |(id, address): &(CameraId, Ipv4Addr)| Camera {
            id: id.clone(),
            address: *address,
            tally: CameraTally::default(),
            outstanding: VecDeque::new(),
        };
        Self(Arc::new(Mutex::new(cameras.iter().map(camera).collect())))
    }

    fn cameras(&self) -> MutexGuard<'_, Vec<Camera>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Counts from nothing again.
    pub fn begin(&self) {
        for camera in self.cameras().iter_mut() {
            camera.tally = CameraTally::default();
            camera.outstanding.clear();
        }
    }

    /// A command was sent to the camera at this place, or not.
    pub(super) fn sent(&self, place: usize, id: u16, sent: bool) {
        let mut cameras = self.cameras();
        let Some(camera) = cameras.get_mut(place) else { return };
        match sent {
            true => {
                camera.tally.sent += 1;
                camera.outstanding.push_back(id);
                if camera.outstanding.len() > OUTSTANDING {
                    camera.outstanding.pop_front();
                }
            }
            false => camera.tally.unsent += 1,
        }
    }

    /// A camera answered. An answer that comes twice counts once: a network may double a packet.
    pub(super) fn answered(&self, from: Ipv4Addr, id: u16, status: ActionStatus) {
        let mut cameras = self.cameras();
        let Some(camera) = cameras.iter_mut().find(|camera| camera.address == from) else { return };
        let Some(place) = camera.outstanding.iter().rposition(|other| *other == id) else { return };
        camera.outstanding.remove(place);
        match status {
            ActionStatus::Taken => camera.tally.taken += 1,
            ActionStatus::Late => camera.tally.late += 1,
            _ => camera.tally.refused += 1,
        }
    }

    /// The counts so far.
    pub fn counts(&self) -> Vec<(CameraId, CameraTally)> {
        self.cameras().iter().map(|camera| (camera.id.clone(), camera.tally)).collect()
    }
}
