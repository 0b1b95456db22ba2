// SPDX-License-Identifier: MIT OR Apache-2.0
//! What fires the triggers, to be connected to: the HSU on its serial line, or this process by action commands.

use super::action::ActionSetup;
use super::error::HsuError;
use super::unit::{Hsu, HsuTimeouts};
use crate::base::ids::NodeId;
use crate::config::{NodeConfig, TriggerSource};
use std::path::PathBuf;

/// One of the two.
#[derive(Debug, Clone)]
pub enum TriggerUnit {
    /// The HSU.
    Serial {
        /// Its serial device.
        device: PathBuf,
        /// Its input that carries linear time code.
        time_code_input: Option<u8>,
    },
    /// Action commands to this node's cameras.
    Action(ActionSetup),
}

impl TriggerUnit {
    /// As a node file says.
    pub fn of(config: &NodeConfig) -> Self {
        match &config.trigger {
            TriggerSource::Hsu { device, time_code_input } => {
                Self::Serial { device: device.clone(), time_code_input: *time_code_input }
            }
            TriggerSource::Action(action) => Self::Action(ActionSetup::of(config, *action)),
        }
    }

    /// The action commands, where they are the triggers.
    pub fn action(&self) -> Option<&ActionSetup> {
        match self {
            Self::Serial { .. } => None,
            Self::Action(setup) => Some(setup),
        }
    }

    /// The input that carries linear time code, where there is one.
    pub fn time_code_input(&self) -> Option<u8> {
        match self {
            Self::Serial { time_code_input, .. } => *time_code_input,
            Self::Action(_) => None,
        }
    }

    /// Connects to it and greets it as this node.
    pub fn connect(&self, role: &NodeId, timeouts: &HsuTimeouts) -> Result<Hsu, HsuError> {
        match self {
            Self::Serial { device, .. } => Hsu::connect(device, role, timeouts),
            Self::Action(setup) => setup.connect(role, timeouts),
        }
    }
}
