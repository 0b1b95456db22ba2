// SPDX-License-Identifier: MIT OR Apache-2.0
//! What an operator asks of a node, and how far the session there has come.

use crate::base::ids::{NodeId, SessionName, check_text};
use serde::{Deserialize, Serialize};

/// What an operator asks for.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct SessionRequest {
    /// The same on both nodes, random.
    pub session_id: u64,
    /// Also the session's directory.
    pub name: String,
    /// Exactly this many triggers; 0: until stopped.
    pub triggers: u64,
    /// The nodes that take part: the HSU starts only when all of them have armed.
    #[schema(value_type = Vec<String>)]
    pub nodes: Vec<NodeId>,
    /// Pseudonymous.
    pub subject: Option<String>,
    /// Free text.
    pub note: Option<String>,
    /// Everything but the recording: frames are counted and judged, nothing is written.
    #[serde(default)]
    pub dry_run: bool,
    /// Whom the node that runs the capture serves; the other nodes' audit logs name them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub on_behalf_of: Option<String>,
}

impl SessionRequest {
    /// The session's name, if everything that was asked for may be recorded; or why not.
    pub fn check(&self) -> Result<SessionName, String> {
        for (what, text) in [("subject", &self.subject), ("note", &self.note)] {
            text.as_ref().map_or(Ok(()), |text| check_text(what, text))?;
        }
        SessionName::parse(&self.name)
    }
}

/// Exposure and gain of the cameras of some heads.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ExposureRequest {
    /// Heads of the rig; those without a camera at this node are the other nodes' business.
    pub heads: Vec<String>,
    /// Exposure, microseconds; without it that stays.
    #[serde(default)]
    pub exposure_us: Option<f64>,
    /// Gain, decibels; without it that stays.
    #[serde(default)]
    pub gain_db: Option<f64>,
    /// Whom the node that passes this on serves; the other node's audit log names them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub on_behalf_of: Option<String>,
}

impl ExposureRequest {
    /// Whether it is about this head.
    pub fn names(&self, head: &str) -> bool {
        self.heads.iter().any(|name| name == head)
    }
}

/// Where the node is in a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// No session.
    Idle,
    /// Opening cameras, creating the recording, starting streams, arming the HSU.
    Preparing,
    /// This node is armed; the HSU accepts a start once every node is.
    Ready,
    /// Triggers are coming.
    Running,
    /// The train has ended; last frames are coming in.
    Draining,
    /// The recording is being closed.
    Closing,
}
