// SPDX-License-Identifier: MIT OR Apache-2.0
//! The unit's timing and arm request, from the rig and the session.

use super::error::HsuError;
use crate::base::ids::{NodeId, SessionName, TriggerIndex};
use crate::config::Rig;
use hsu_firmware_proto::{Arm, HeadTiming, LINKS, NodeName, SessionId, Sync, Timing, TriggerRecord};
use sha2::{Digest, Sha256};
use std::time::Duration;

/// The times at which projectors and cameras are triggered. Head number h is the rig's head h.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HsuTiming {
    /// Time from trigger to trigger, ns.
    pub period_ns: u64,
    /// Source of the triggers: the unit's timer or the projector.
    pub sync: Sync,
    /// Silence after which the unit considers a host dead.
    pub host_silence: Duration,
    /// Per head: delay after the projector's frame sync, and exposure, ns.
    pub heads: Vec<HeadTiming>,
}

impl HsuTiming {
    /// The timing of a rig file; the unit's timer drives the projectors.
    pub fn from_rig(rig: &Rig) -> Self {
        Self {
            period_ns: (1e9 / rig.trigger_rate_hz).round() as u64,
            sync: Sync::Timer,
            host_silence: Duration::from_secs(2),
            heads: rig
                .heads
                .iter()
                .map(|head| HeadTiming { delay_ns: head.delay_ns, exposure_ns: head.exposure_ns })
                .collect(),
        }
    }

    /// The timing for the protocol; an error where the unit could not run it.
    pub(super) fn to_wire(&self) -> Result<Timing, HsuError> {
        let silence_ns = u64::try_from(self.host_silence.as_nanos()).unwrap_or(u64::MAX);
        Timing::new(self.period_ns, self.sync, silence_ns, &self.heads)
            .map_err(|error| HsuError::Unfit(format!("the rig's timing does not suit the HSU: {error}")))
    }
}

/// The arm request, which every node must send in the same way before a train can start.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ArmRequest {
    /// Id of the session, see [`session_id`].
    pub session: SessionId,
    /// Number of triggers without warm-up; `None`: until stopped.
    pub triggers: Option<u64>,
    /// Number of triggers before trigger index 0, for cameras that need some to wake up.
    pub warm_up: u32,
    /// The nodes that must arm.
    pub nodes: Vec<NodeId>,
}

impl ArmRequest {
    pub(super) fn to_wire(&self, timing_digest: u32) -> Result<Arm, HsuError> {
        if self.nodes.is_empty() || self.nodes.len() > LINKS {
            return Err(HsuError::Unfit(format!(
                "{} nodes are to arm the HSU: expected 1 to {LINKS}, one a link",
                self.nodes.len()
            )));
        }
        // Sorted, because the unit compares the requests of the links.
        let mut nodes: Vec<&NodeId> = self.nodes.iter().collect();
        nodes.sort();
        let mut expected = [NodeName::NONE; LINKS];
        for (place, node) in expected.iter_mut().zip(nodes) {
            *place = node_name(node)?;
        }
        let (session, warm_up) = (self.session, self.warm_up);
        Ok(Arm { session, trigger_count: self.triggers.unwrap_or(0), warm_up, timing_digest, expected })
    }
}

/// A node's name for the protocol.
pub(super) fn node_name(node: &NodeId) -> Result<NodeName, HsuError> {
    NodeName::new(node.as_str()).filter(|name| !name.is_none()).ok_or_else(|| {
        HsuError::Unfit(format!(
            "node name {:?} does not suit the HSU: expected 1 to 16 bytes",
            node.as_str()
        ))
    })
}

/// The id under which all nodes arm a session: the first 16 bytes of the SHA-256 of its name.
pub fn session_id(session: &SessionName) -> SessionId {
    let digest = Sha256::digest(session.as_str());
    SessionId(digest.first_chunk().copied().unwrap_or_default())
}

/// The trigger index of a trigger; `None` for a warm-up trigger.
pub fn trigger_index(record: &TriggerRecord) -> Option<TriggerIndex> {
    u64::try_from(record.number).ok().map(TriggerIndex)
}
