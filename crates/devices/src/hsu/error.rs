// SPDX-License-Identifier: MIT OR Apache-2.0
//! What can go wrong between a node and the HSU.

use hsu_firmware_proto::{Refusal, TimingError, version};
use std::time::Duration;

/// A command that was not carried out.
#[derive(Debug, thiserror::Error)]
pub enum HsuError {
    /// The serial device could not be opened.
    #[error(
        "cannot open the HSU's serial device {device}: {cause}; expected a free serial port: check the path, the permissions (group dialout) and that no other program has it open"
    )]
    Open {
        /// The device.
        device: String,
        /// The system's words.
        cause: String,
    },
    /// The device is silent.
    #[error(
        "no answer from the HSU on {device} to {request}: expected one within {waited:?} ({attempts} attempts), found silence; check its power, the cable, and that the device is the HSU's"
    )]
    NoAnswer {
        /// The device.
        device: String,
        /// What was asked.
        request: &'static str,
        /// How often.
        attempts: u32,
        /// For how long altogether.
        waited: Duration,
    },
    /// The unit answered that it will not.
    #[error("the HSU refused {request}: {refusal}")]
    Refused {
        /// What was asked.
        request: &'static str,
        /// Why it will not.
        refusal: Refusal,
    },
    /// Something speaks the protocol, but is not an HSU of this project.
    #[error("{device} is a {found:?}, expected a \"fourdbody-hsu\": is the right device configured?")]
    WrongDevice {
        /// The device.
        device: String,
        /// The name that it gave.
        found: String,
    },
    /// The two ends have no protocol version in common.
    #[error(
        "the HSU on {device} speaks protocol versions {unit_min} to {unit_current}, this program {} to {}: update the older of the two",
        version::MIN,
        version::CURRENT
    )]
    WrongVersion {
        /// The device.
        device: String,
        /// Oldest version that the unit speaks.
        unit_min: u8,
        /// Newest version that the unit speaks.
        unit_current: u8,
    },
    /// The answer is one that this request cannot have.
    #[error("the HSU answered {request} with {found}: expected {expected}")]
    Unexpected {
        /// What was asked.
        request: &'static str,
        /// What would have fitted.
        expected: &'static str,
        /// What came.
        found: String,
    },
    /// The line broke: the device is gone or its driver failed.
    #[error("the link to the HSU on {device} is broken: {cause}; check the cable, then connect again")]
    Io {
        /// The device.
        device: String,
        /// The system's words.
        cause: String,
    },
    /// The rig's timing cannot be run by an HSU.
    #[error("the rig's timing does not suit the HSU: {0}")]
    Timing(#[from] TimingError),
    /// A name does not fit the 16 bytes that it has on the wire.
    #[error("node name {name:?} does not suit the HSU: expected 1 to 16 bytes")]
    Name {
        /// The name.
        name: String,
    },
    /// More nodes than links.
    #[error("{found} nodes are to arm the HSU: expected 1 to {}, one a link", hsu_firmware_proto::LINKS)]
    Nodes {
        /// How many.
        found: usize,
    },
    /// The state that was waited for did not come.
    #[error("the HSU did not become {expected} within {waited:?}: it is {found}")]
    Late {
        /// What was waited for.
        expected: &'static str,
        /// What it is.
        found: String,
        /// For how long.
        waited: Duration,
    },
}
