// SPDX-License-Identifier: MIT OR Apache-2.0
//! What an operator asks of a node, and how far the session there has come.

use crate::base::ids::{NodeId, SessionName, check_text};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// What an operator asks for.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct SessionRequest {
    /// The same on both nodes, random.
    pub session_id: u64,
    /// The session's name, and the name of its directory.
    pub name: String,
    /// Exactly this many triggers; 0: until stopped.
    pub triggers: u64,
    /// The nodes that take part: the HSU starts only when all of them have armed.
    #[schema(value_type = Vec<String>)]
    pub nodes: Vec<NodeId>,
    /// A pseudonym of the subject, never a name.
    pub subject: Option<String>,
    /// A free text of the operator.
    pub note: Option<String>,
    /// The train starts at this edge of one of the HSU's inputs, not at once.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start_on: Option<StartOn>,
    /// Number of triggers before Record that are kept: the train starts, frames are held in memory, and nothing is
    /// written before it. 0: the recording begins with the train.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub pre_triggers: u64,
    /// Everything but the recording: frames are counted and judged, nothing is written.
    #[serde(default)]
    pub dry_run: bool,
    /// A dry run without an end for those who look at the pictures: it ends as soon as the node is asked for anything
    /// else.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub preview: bool,
    /// Whom the node that runs the capture serves; the other nodes' audit logs name them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub on_behalf_of: Option<String>,
}

pub(crate) fn is_zero(number: &u64) -> bool {
    *number == 0
}

impl SessionRequest {
    /// The session's name, if the whole request may be recorded; or why not.
    pub fn check(&self) -> Result<SessionName, String> {
        for (what, text) in [("subject", &self.subject), ("note", &self.note)] {
            text.as_ref().map_or(Ok(()), |text| check_text(what, text))?;
        }
        if let Some(StartOn { line, .. }) = self.start_on.filter(|edge| edge.line >= StartOn::LINES) {
            return Err(format!("input {line}; expected 0 to {}", StartOn::LINES - 1));
        }
        if self.pre_triggers > 0 && (self.triggers > 0 || self.dry_run || self.start_on.is_some()) {
            let expected = "expected no number of triggers, no dry run and no start at an edge with it";
            return Err(format!("{} triggers before Record; {expected}", self.pre_triggers));
        }
        if self.preview && (!self.dry_run || self.triggers > 0 || self.start_on.is_some()) {
            let expected = "expected a dry run without a number of triggers and without a start at an edge";
            return Err(format!("a preview that records or ends by itself; {expected}"));
        }
        SessionName::parse(&self.name)
    }
}

/// Record was pressed: the recording begins with a trigger of the past.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct KeepRequest {
    /// The id of the session.
    pub session_id: u64,
    /// The trigger of the train that becomes the recording's trigger 0: the same on all nodes.
    pub first: u64,
    /// The newest trigger of which every node had the frames when it was pressed.
    pub pressed: u64,
}

/// An edge of one of the HSU's inputs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct StartOn {
    /// The input, 0 to 7.
    #[schema(maximum = 7)]
    pub line: u8,
    /// Whether the edge goes from low to high.
    #[serde(default = "rising")]
    pub rising: bool,
}

fn rising() -> bool {
    true
}

impl StartOn {
    pub const LINES: u8 = crate::hsu::INPUTS as u8;
}

impl fmt::Display for StartOn {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} edge of input {}", if self.rising { "rising" } else { "falling" }, self.line)
    }
}

impl FromStr for StartOn {
    type Err = String;

    /// Accepts `2`, `2:rising` or `2:falling`, with 2 for any input.
    fn from_str(text: &str) -> Result<Self, String> {
        let (line, rising) = match text.split_once(':') {
            None => (text, true),
            Some((line, "rising")) => (line, true),
            Some((line, "falling")) => (line, false),
            Some((_, edge)) => return Err(format!("edge {edge:?}; expected rising or falling")),
        };
        match line.parse() {
            Ok(line) if line < Self::LINES => Ok(Self { line, rising }),
            _ => Err(format!("input {line:?}; expected 0 to {}", Self::LINES - 1)),
        }
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
    /// The node is in no session.
    Idle,
    /// Opening cameras, creating the recording, starting streams, arming the HSU.
    Preparing,
    /// This node is armed; the HSU accepts a start once every node is.
    Ready,
    /// Triggers are coming, and the frames of the last seconds are held: nothing is recorded before Record.
    Holding,
    /// Triggers are coming, and are recorded.
    Running,
    /// The train has ended; last frames are coming in.
    Draining,
    /// The recording is being closed.
    Closing,
}

#[cfg(test)]
mod tests {
    use super::StartOn;

    #[test]
    fn an_edge_is_read_as_people_write_it() {
        let edge = |line, rising| Ok(StartOn { line, rising });
        assert_eq!("2".parse(), edge(2, true));
        assert_eq!("0:rising".parse(), edge(0, true));
        assert_eq!("7:falling".parse(), edge(7, false));
        for wrong in ["", "8", "-1", "2:up", "x:rising", ":falling"] {
            assert!(wrong.parse::<StartOn>().is_err(), "{wrong:?}");
        }
    }
}
