// SPDX-License-Identifier: MIT OR Apache-2.0
//! The source of triggers: the HSU on its serial line, or action commands of this process.

use super::action::ActionSetup;
use super::error::HsuError;
use super::link::HsuTimeouts;
use super::unit::{Hsu, UnderWay};
use crate::base::ids::NodeId;
use crate::config::{NodeConfig, TriggerSource};
use std::path::PathBuf;

/// The source of a node's triggers, from its node file. [`TriggerUnit::connect`] makes the connection.
#[derive(Debug, Clone)]
pub enum TriggerUnit {
    /// The HSU on a serial device; `time_code_input` is its input that carries linear time code.
    Serial { device: PathBuf, time_code_input: Option<u8> },
    /// Action commands to this node's cameras.
    Action(ActionSetup),
}

impl TriggerUnit {
    /// The source that a node file names.
    pub fn of(config: &NodeConfig) -> Self {
        match &config.trigger {
            TriggerSource::Hsu { device, time_code_input } => {
                Self::Serial { device: device.clone(), time_code_input: *time_code_input }
            }
            TriggerSource::Action(action) => Self::Action(ActionSetup::of(config, *action)),
        }
    }

    /// The action commands, where they are the source.
    pub fn action(&self) -> Option<&ActionSetup> {
        match self {
            Self::Serial { .. } => None,
            Self::Action(setup) => Some(setup),
        }
    }

    /// The HSU's input that carries linear time code, where there is one.
    pub fn time_code_input(&self) -> Option<u8> {
        match self {
            Self::Serial { time_code_input, .. } => *time_code_input,
            Self::Action(_) => None,
        }
    }

    /// Connects to the source and greets it as this node.
    pub fn connect(&self, role: &NodeId, timeouts: &HsuTimeouts) -> Result<Hsu, HsuError> {
        self.open(role, timeouts, None)
    }

    /// As [`Self::connect`], in a session that goes on.
    pub fn reconnect(
        &self,
        role: &NodeId,
        timeouts: &HsuTimeouts,
        session: UnderWay,
    ) -> Result<Hsu, HsuError> {
        self.open(role, timeouts, Some(session))
    }

    fn open(
        &self,
        role: &NodeId,
        timeouts: &HsuTimeouts,
        session: Option<UnderWay>,
    ) -> Result<Hsu, HsuError> {
        match self {
            Self::Serial { device, .. } => Hsu::open(device, role, timeouts, session),
            Self::Action(setup) => setup.connect(role, timeouts, session),
        }
    }
}
