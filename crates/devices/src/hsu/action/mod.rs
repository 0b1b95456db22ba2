// SPDX-License-Identifier: MIT OR Apache-2.0
//! Triggers without an HSU: action commands of GigE Vision, sent by this process.
//!
//! The unit's own state machine (`hsu_firmware_proto::Unit`) runs on a thread of the node, behind a link of the same
//! messages. So arming, exactly N triggers, the rhythm of the warm-up and every report are as with an HSU.
//! `docs/design/action-triggers.md` says what holds and what does not.

mod engine;
mod pipe;
mod probe;
mod ptp_clock;
mod tally;
mod untimely;

pub use ptp_clock::PtpClock;
pub use tally::ActionTally;

use super::error::HsuError;
use super::unit::{Hsu, HsuTimeouts};
use crate::base::ids::{CameraId, NodeId};
use crate::config::{ACTION_COMMANDS, ActionConfig, NodeConfig};
use crate::network::ActionKeys;
use std::net::Ipv4Addr;
use std::time::Duration;

/// The product name of what plays the HSU's part.
pub const PRODUCT: &str = "fourdbody-action";

/// Scheduled actions leave so long before their time at most.
const LEAD_MOST: Duration = Duration::from_millis(10);

/// Everything that action commands need.
#[derive(Debug, Clone)]
pub struct ActionSetup {
    /// The cameras with their addresses, in the node's order.
    pub cameras: Vec<(CameraId, Ipv4Addr)>,
    /// Which keys they have.
    pub keys: ActionKeys,
    /// The clock that the cameras share; `None`: each acts when the packet reaches it.
    pub ptp: Option<PtpClock>,
    /// What became of the commands.
    pub tally: ActionTally,
    /// Scheduled actions leave so long before their time.
    lead: Duration,
}

impl ActionSetup {
    /// As a node file says; cameras without an IPv4 address are refused by the file's check.
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

    /// Starts a unit of its own and greets it as this node; it ends with the link.
    pub(super) fn connect(&self, role: &NodeId, timeouts: &HsuTimeouts) -> Result<Hsu, HsuError> {
        let device = ACTION_COMMANDS.to_owned();
        let (reader, writer) = engine::start(self)
            .map_err(|error| HsuError::Io { device: device.clone(), cause: error.to_string() })?;
        Hsu::over(reader, writer, device, role, timeouts)
    }
}

/// The id of the command for a trigger: ids count the triggers, and 0 is none.
pub fn request_id(number: i64) -> u16 {
    // Below 65535, so that one more fits.
    u16::try_from(number.rem_euclid(i64::from(u16::MAX))).unwrap_or(0) + 1
}

#[cfg(test)]
mod tests;
