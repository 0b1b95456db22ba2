// SPDX-License-Identifier: MIT OR Apache-2.0
//! Triggers without an HSU: action commands of GigE Vision, sent by this process.
//!
//! The unit's own state machine (`hsu_firmware_proto::Unit`) runs on a thread of the node, behind a link of the same
//! messages. So arming, exactly N triggers, the rhythm of the warm-up and every report are as with an HSU.
//! The guarantees are in
//! `docs/design/action-triggers.md`.

mod engine;
mod pipe;
mod probe;
mod ptp_clock;
mod tally;
mod untimely;

pub use ptp_clock::PtpClock;
pub use tally::ActionTally;

use super::error::HsuError;
use super::link::HsuTimeouts;
use super::unit::{Hsu, UnderWay};
use crate::base::ids::{CameraId, NodeId};
use crate::config::{ACTION_COMMANDS, ActionConfig, NodeConfig};
use crate::network::ActionKeys;
use std::net::Ipv4Addr;
use std::time::Duration;

/// Longest time by which scheduled actions are sent ahead.
const LEAD_MOST: Duration = Duration::from_millis(10);

/// The parameters of action commands, from the node file.
#[derive(Debug, Clone)]
pub struct ActionSetup {
    /// The cameras with their addresses, in the node's order.
    pub cameras: Vec<(CameraId, Ipv4Addr)>,
    /// Device key, group key and group mask of the cameras.
    pub keys: ActionKeys,
    /// The clock that the cameras share by PTP; `None`: each camera acts when the packet reaches it.
    pub ptp: Option<PtpClock>,
    /// Counts of the commands by camera.
    pub tally: ActionTally,
    /// Time by which scheduled actions are sent ahead.
    lead: Duration,
}

impl ActionSetup {
    /// The parameters of a node file, whose check refuses cameras without an IPv4 address.
    pub fn of(config: &NodeConfig, action: ActionConfig) -> Self {
        let address = |camera: &crate::config::CameraConfig| {
            Some((camera.id.clone(), camera.address.parse::<Ipv4Addr>().ok()?))
        };
        let cameras: Vec<_> = config.cameras.iter().filter_map(address).collect();
        let period = Duration::from_secs_f64(1.0 / config.rig.trigger_rate_hz);
        Self {
            tally: ActionTally::new(&cameras),
            cameras,
            keys: ActionKeys { device: action.device_key, group: action.group_key, mask: action.group_mask },
            ptp: action.ptp.then(PtpClock::default),
            lead: (period / 2).min(LEAD_MOST),
        }
    }

    /// Starts a unit in this process and greets it as this node; it ends with the link.
    pub(super) fn connect(
        &self,
        role: &NodeId,
        timeouts: &HsuTimeouts,
        session: Option<UnderWay>,
    ) -> Result<Hsu, HsuError> {
        let device = ACTION_COMMANDS.to_owned();
        let (reader, writer) = engine::start(self)
            .map_err(|error| HsuError::Io { device: device.clone(), cause: error.to_string() })?;
        Hsu::over(reader, writer, device, role, timeouts, session)
    }
}

#[cfg(test)]
mod tests;
