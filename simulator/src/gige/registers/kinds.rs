// SPDX-License-Identifier: MIT OR Apache-2.0
//! Registers of cameras that are not the simulator's own: of a make from a table, or behind a published description.

use super::{CameraClock, Effect, Firmware, Habits, Identity, Make, Network, Registers};
use crate::gige::described::{Described, Done};
use crate::gige::map::{REGISTERS, find};
use std::sync::Arc;

/// Bootstrap registers end here; what a description puts between them is its own.
const BOOTSTRAP_END: u32 = 0xa000;

impl Registers {
    /// Registers after power-on of a camera of this make.
    pub fn of_make(
        identity: Identity,
        sensor: (u32, u32),
        clock: Arc<CameraClock>,
        habits: Habits,
        make: Arc<Make>,
        network: &Network,
    ) -> Self {
        let firmware = Firmware::new(make, sensor, habits);
        let mut xml = firmware.description().into_bytes();
        xml.resize(xml.len().next_multiple_of(4), b'\n');
        let settings = firmware.settings();
        let packet_size = firmware.first_packet_size();
        let plain = Self::new(identity, sensor, clock, habits);
        Self { firmware: Some(firmware), xml, settings, packet_size, network: network.clone(), ..plain }
    }

    /// Behind a published description, once it is switched on.
    #[must_use]
    pub fn behind(self, described: Option<Arc<Described>>) -> Self {
        let registers = Self { described, ..self };
        registers.note();
        registers
    }

    /// Leaves its bootstrap registers with the description, for whoever reads the memory behind it.
    pub fn note(&self) {
        if let Some(described) = &self.described {
            described.note(self.bootstrap());
        }
    }

    fn bootstrap(&self) -> Vec<(u32, u32)> {
        let own = REGISTERS.iter().filter(|register| register.address < BOOTSTRAP_END);
        let words = own.flat_map(|r| (r.address..r.address + u32::from(r.length)).step_by(4));
        words.filter_map(|at| Some((at, u32::from_be_bytes(self.word(at)?)))).collect()
    }

    fn is_memory(address: u32) -> bool {
        address >= BOOTSTRAP_END || find(address).is_none()
    }

    /// The word of the camera's own memory, where it is one behind a description and that lies there.
    pub(super) fn memory_word(&self, address: u32) -> Option<[u8; 4]> {
        let described = self.described.as_ref().filter(|_| Self::is_memory(address))?;
        Some(described.word(address))
    }

    /// Writes to it; returns how many bytes were taken.
    pub(super) fn write_memory(&mut self, address: u32, data: &[u8]) -> Option<(usize, Option<Effect>)> {
        let described = self.described.clone().filter(|_| Self::is_memory(address))?;
        let words = (address..).step_by(4).take(data.len() / 4);
        let length = 4 * words.take_while(|at| Self::is_memory(*at)).count();
        let effect = match described.write(address, &data[..length]) {
            Done::Nothing => None,
            Done::Stop => Some(Effect::Stop),
            Done::Start => {
                if let Some(settings) = described.works_as() {
                    self.settings = settings;
                }
                Some(Effect::Start)
            }
        };
        Some((length, effect))
    }
}
