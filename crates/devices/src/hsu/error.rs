// SPDX-License-Identifier: MIT OR Apache-2.0
//! Errors between a node and the HSU.

use hsu_firmware_proto::{Refusal, UnitToHost};
use std::time::Duration;

/// A command that was not carried out. `device`: the serial device, or what stands in for it; `request`: the command in
/// words; `cause`: the error text of the system.
#[derive(Debug, thiserror::Error)]
pub enum HsuError {
    /// The serial device could not be opened.
    #[error(
        "cannot open the HSU's serial device {device}: {cause}; expected a free serial port: check the path, the \
         permissions (group dialout) and that no other program has it open"
    )]
    Open { device: String, cause: String },
    /// The unit did not answer. `waited`: the time for all attempts together.
    #[error(
        "no answer from the HSU on {device} to {request}: expected one within {waited:?} ({attempts} attempts), found \
         silence; check its power, the cable, and that the device is the HSU's"
    )]
    NoAnswer { device: String, request: &'static str, attempts: u32, waited: Duration },
    /// The unit refused the request for a reason of the protocol.
    #[error("the HSU refused {request}: {refusal}")]
    Refused { request: &'static str, refusal: Refusal },
    /// The line broke: the device is gone or its driver failed.
    #[error("the link to the HSU on {device} is broken: {cause}; check the cable, then connect again")]
    Io { device: String, cause: String },
    /// The unit and what is requested of it do not fit together; the text names expected and found.
    #[error("{0}")]
    Unfit(String),
    /// The state that was waited for did not come.
    #[error("the HSU did not become {expected} within {waited:?}: it is {found}")]
    Late { expected: &'static str, found: String, waited: Duration },
}

impl HsuError {
    /// The error for an answer that does not belong to its request.
    pub(super) fn unexpected(request: &str, expected: &str, found: &UnitToHost) -> Self {
        Self::Unfit(format!("the HSU answered {request} with {found:?}: expected {expected}"))
    }
}
