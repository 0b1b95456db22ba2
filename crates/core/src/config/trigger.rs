// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where triggers come from: the HSU, or action commands of this node (`[trigger]` and `[hsu]` of a node file).

use super::node::CameraConfig;
use super::rig::Rig;
use super::section::Section;
use hsu_firmware_proto::INPUTS;
use serde::{Deserialize, Serialize};
use std::net::Ipv4Addr;
use std::path::PathBuf;

/// What action commands are called where a serial device would be named.
pub const ACTION_COMMANDS: &str = "action commands";

/// What triggers the cameras of a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum TriggerSource {
    /// The HSU, by wires to projectors and cameras.
    Hsu {
        /// Serial device of the link to it.
        device: PathBuf,
        /// The HSU's input that carries linear time code.
        time_code_input: Option<u8>,
    },
    /// This node, by action commands over the network.
    Action(ActionConfig),
}

/// Action commands of GigE Vision.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ActionConfig {
    pub device_key: u32,
    pub group_key: u32,
    /// `ActionGroupMask` of the cameras; not 0.
    pub group_mask: u32,
    /// The cameras' clocks are set to each other by PTP, and actions are scheduled on that clock. Otherwise a camera
    /// acts when the packet reaches it.
    pub ptp: bool,
}

impl TriggerSource {
    /// The action commands, where they are the triggers.
    pub fn action(&self) -> Option<ActionConfig> {
        match self {
            Self::Hsu { .. } => None,
            Self::Action(action) => Some(*action),
        }
    }

    /// The name that stands where the HSU's serial device is named.
    pub fn device(&self) -> PathBuf {
        match self {
            Self::Hsu { device, .. } => device.clone(),
            Self::Action(_) => PathBuf::from(ACTION_COMMANDS),
        }
    }

    /// Notes what action commands cannot do for this rig, and what they require of its cameras.
    pub(super) fn check(&self, root: &Section<'_>, rig: &Rig, cameras: &[CameraConfig]) {
        if self.action().is_none() {
            return;
        }
        const SOURCE: &str = "trigger.source";
        let nodes = rig.nodes().len();
        if nodes > 1 {
            root.problem(
                SOURCE,
                format!(
                    "\"action\" triggers the cameras of one node, and the rig has {nodes}: expected all cameras on \
                     one node, or an HSU (source = \"hsu\"), which both nodes arm"
                ),
            );
        }
        if let Some(head) = rig.heads.iter().find(|head| head.delay_ns != rig.heads[0].delay_ns) {
            root.problem(
                SOURCE,
                format!(
                    "\"action\" triggers no projector, and head {} has another delay_us than head {}: its projector \
                     takes turns, which needs an HSU (source = \"hsu\"); with patterns that stand still, give all \
                     heads the same delay_us",
                    head.id, rig.heads[0].id
                ),
            );
        }
        for (i, camera) in cameras.iter().enumerate() {
            if camera.address.parse::<Ipv4Addr>().is_err() {
                let message = format!(
                    "action commands go to an IPv4 address, found {:?}: give {}'s",
                    camera.address, camera.id
                );
                root.problem(&format!("camera[{i}].address"), message);
            }
            let stated = [
                ("trigger_line", camera.words.trigger_line.is_some()),
                ("trigger_edge", camera.words.trigger_edge.is_some()),
            ];
            for (word, _) in stated.into_iter().filter(|(_, is_there)| *is_there) {
                let message = format!(
                    "is given for {}, and its triggers are action commands, which come by no line: leave it out",
                    camera.id
                );
                root.problem(&format!("camera[{i}].{word}"), message);
            }
        }
    }
}

/// Reads `[trigger]`, which may be left out, and `[hsu]`, which an HSU needs.
pub(super) fn read_trigger(root: &Section<'_>) -> Option<TriggerSource> {
    const INPUT: &str = "time_code_input";
    let action = root.optional_section("trigger").and_then(|section| {
        let is_action = section.choice("source", &[("hsu", false), ("action", true)]);
        let key = |key, least| u32::try_from(section.integer_or(key, least..=u64::from(u32::MAX), 1));
        let action = is_action.then(|| ActionConfig {
            device_key: key("device_key", 0).unwrap_or(1),
            group_key: key("group_key", 0).unwrap_or(1),
            group_mask: key("group_mask", 1).unwrap_or(1),
            ptp: section.flag_or("ptp", true),
        });
        section.finish();
        action
    });
    if let Some(action) = action {
        if root.optional_section("hsu").is_some() {
            let message = "an HSU is configured, and trigger.source is \"action\": leave out one of the two";
            root.problem("hsu", message);
        }
        return Some(TriggerSource::Action(action));
    }
    root.section("hsu").map(|section| {
        let device = PathBuf::from(section.text("device"));
        let inputs = 0..=(INPUTS as u64 - 1);
        let time_code_input =
            section.has(INPUT).then(|| u8::try_from(section.integer_or(INPUT, inputs, 0)).unwrap_or(0));
        section.finish();
        TriggerSource::Hsu { device, time_code_input }
    })
}
