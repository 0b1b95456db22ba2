// SPDX-License-Identifier: MIT OR Apache-2.0
//! Counts of the action commands by camera: each is sent once, and acknowledged at most once.

use super::untimely::Untimely;
use crate::base::ids::CameraId;
use crate::base::time::monotonic_ns;
use crate::network::ActionStatus;
use crate::record::{ActionCounts, TriggerRow};
use std::collections::VecDeque;
use std::net::Ipv4Addr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// The command id for a trigger: ids count the triggers, and 0 is not used.
pub(super) fn request_id(number: i64) -> u16 {
    // The remainder is below 65535, so that one more fits into 16 bits.
    u16::try_from(number.rem_euclid(i64::from(u16::MAX))).unwrap_or(0) + 1
}

/// Most commands per camera whose answer may still come.
const OUTSTANDING: usize = 256;

#[derive(Debug)]
struct Camera {
    id: CameraId,
    address: Ipv4Addr,
    counts: ActionCounts,
    untimely: Untimely,
    /// Command ids without an answer yet, with their triggers.
    outstanding: VecDeque<(u16, i64)>,
}

#[derive(Debug)]
struct Train {
    cameras: Vec<Camera>,
    /// The newest trigger and its time on this host's monotonic clock, ns.
    newest: Option<(i64, u64)>,
}

impl Train {
    /// The first trigger that is not exposed yet; the least number before the first one.
    fn unexposed(&self) -> i64 {
        match self.newest {
            None => i64::MIN,
            Some((number, at_ns)) if at_ns > monotonic_ns(Instant::now()) => number,
            Some((number, _)) => number.saturating_add(1),
        }
    }

    fn camera(&mut self, id: &CameraId) -> Option<&mut Camera> {
        self.cameras.iter_mut().find(|camera| camera.id == *id)
    }
}

/// Counts of all cameras, shared by the thread that sends, the one that watches PTP, and the one that reports.
#[derive(Debug, Clone)]
pub struct ActionTally(Arc<Mutex<Train>>);

impl ActionTally {
    pub(super) fn new(cameras: &[(CameraId, Ipv4Addr)]) -> Self {
        let camera = |(id, address): &(CameraId, Ipv4Addr)| Camera {
            id: id.clone(),
            address: *address,
            counts: ActionCounts::default(),
            untimely: Untimely::default(),
            outstanding: VecDeque::new(),
        };
        let cameras = cameras.iter().map(camera).collect();
        Self(Arc::new(Mutex::new(Train { cameras, newest: None })))
    }

    fn train(&self) -> MutexGuard<'_, Train> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets all counts to zero for a new session.
    pub fn begin(&self) {
        let mut train = self.train();
        train.newest = None;
        for camera in &mut train.cameras {
            camera.counts = ActionCounts::default();
            camera.untimely = Untimely::default();
            camera.outstanding.clear();
        }
    }

    /// Notes a trigger whose commands are about to be sent, with its time on this host's monotonic clock, ns.
    pub(super) fn fires(&self, number: i64, at_ns: u64) {
        self.train().newest = Some((number, at_ns));
    }

    /// Counts a trigger's command to the camera at this place; `sent`: whether this host could send it.
    pub(super) fn sent(&self, place: usize, number: i64, sent: bool) {
        let mut train = self.train();
        let Some(camera) = train.cameras.get_mut(place) else { return };
        if !sent {
            camera.counts.not_sent += 1;
            return;
        }
        camera.counts.sent += 1;
        camera.counts.unanswered += 1;
        camera.outstanding.push_back((request_id(number), number));
        if camera.outstanding.len() > OUTSTANDING {
            camera.outstanding.pop_front();
        }
    }

    /// Counts a camera's answer. An answer that comes twice counts once, because a network may duplicate a packet.
    pub(super) fn answered(&self, from: Ipv4Addr, id: u16, status: ActionStatus) {
        let mut train = self.train();
        let Some(camera) = train.cameras.iter_mut().find(|camera| camera.address == from) else { return };
        let Some(place) = camera.outstanding.iter().rposition(|(other, _)| *other == id) else { return };
        let Some((_, number)) = camera.outstanding.remove(place) else { return };
        camera.counts.unanswered -= 1;
        match status {
            ActionStatus::Taken => camera.counts.acknowledged += 1,
            ActionStatus::Late => camera.counts.late += 1,
            _ => camera.counts.refused += 1,
        }
        camera.untimely.answered(number, status);
    }

    /// The first trigger that is not exposed yet; to be read before a camera's PTP status is requested.
    pub fn unexposed(&self) -> i64 {
        self.train().unexposed()
    }

    /// Notes a camera's PTP status; `requested` was the first unexposed trigger when the status was requested.
    pub fn ptp(&self, camera: &CameraId, status: &str, requested: i64) {
        let mut train = self.train();
        let now = train.unexposed();
        if let Some(camera) = train.camera(camera) {
            camera.untimely.ptp(status, requested, now);
        }
    }

    /// Notes that a camera was lost: its PTP status is not known any more.
    pub fn lost(&self, camera: &CameraId) {
        if let Some(camera) = self.train().camera(camera) {
            camera.untimely.lost();
        }
    }

    /// The counts of each camera so far.
    pub fn counts(&self) -> Vec<(CameraId, ActionCounts)> {
        self.train().cameras.iter().map(|camera| (camera.id.clone(), camera.counts)).collect()
    }

    /// Triggers at which a camera did not, or may not have, exposed at the same time as the others, with the reason.
    pub fn untimely(&self) -> Vec<(CameraId, TriggerRow, String)> {
        let train = self.train();
        let now = train.unexposed();
        let rows = |camera: &Camera| {
            let id = camera.id.clone();
            camera.untimely.rows(now).into_iter().map(move |(row, why)| (id.clone(), row, why))
        };
        train.cameras.iter().flat_map(rows).collect()
    }
}
