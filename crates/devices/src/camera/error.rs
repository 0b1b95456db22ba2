// SPDX-License-Identifier: MIT OR Apache-2.0
//! Why a camera cannot be used, and what to do.

/// A camera failure, with what the operator can do about it. `detail` is the error text of Aravis.
#[derive(Debug, thiserror::Error)]
pub enum CameraError {
    /// No camera answers at the configured address.
    #[error(
        "no camera answers at {address} ({detail}); check its power and cable, and the address in the node file"
    )]
    NotFound { address: String, detail: String },
    /// Another program holds the control privilege; `holder` is its address and port, where the camera reports it.
    #[error(
        "the camera at {address} is controlled by another program{}; close that program, or wait until its heartbeat \
         times out",
        holder.as_ref().map(|host| format!(" on {host}")).unwrap_or_default()
    )]
    Owned { address: String, holder: Option<String> },
    /// The camera answers, but refuses commands that only its controller may give. `holder`: address and port of the
    /// controlling program, where there is one and the camera reports it.
    #[error(
        "the camera is not under our control any more ({detail}){}; close the program that took it",
        holder.as_ref().map(|host| format!(": {host} controls it")).unwrap_or_default()
    )]
    NotOurs { holder: Option<String>, detail: String },
    /// The camera cannot be set as the node file requests, or would not send what a session records. Each problem has
    /// its feature, its value and its remedy.
    #[error("it cannot be used as it is:\n  {}", problems.join("\n  "))]
    SetUp { problems: Vec<String> },
    /// The communication with an opened camera failed.
    #[error(
        "communication with the camera failed while {doing} ({detail}); check its power, cable and switch"
    )]
    Link { doing: &'static str, detail: String },
    /// The camera's answer cannot be true, as an image without rows.
    #[error(
        "the camera answers nonsense while {doing} ({detail}); restart it, and if that does not help ask its vendor \
         for \
         other firmware"
    )]
    Nonsense { doing: &'static str, detail: String },
    /// The camera sends test packets, and none arrives. `patience_ms`: the wait for packets of one size.
    #[error(
        "no test packet of the camera arrives, of whatever size, within {patience_ms} ms; look for a firewall that \
         drops \
         them, see `fourdbody doctor`, and whether the camera has a route to this host's address"
    )]
    NoTestPackets { patience_ms: u128 },
    /// This host has no memory for the camera's frames.
    #[error("{0}")]
    Memory(String),
}
