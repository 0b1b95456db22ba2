// SPDX-License-Identifier: MIT OR Apache-2.0
//! Checks before a session that every camera answers an action command with its keys. No camera acquires at that time.

use super::ActionSetup;
use crate::base::ids::CameraId;
use crate::network::{ActionStatus, GVCP_PORT, action, action_reply, receive_until};
use std::io;
use std::net::{Ipv4Addr, UdpSocket};
use std::time::{Duration, Instant};

/// Longest wait for an answer; without one the packet was lost.
const PATIENCE: Duration = Duration::from_millis(200);
/// How often the command is sent, because packets may get lost.
const ATTEMPTS: u16 = 3;
/// First command id of the check; no trigger near the beginning of a session has it.
const FIRST_ID: u16 = 0x8000;

impl ActionSetup {
    /// Sends each camera one immediate action. Gives the cameras that do not accept it, with the reason and the remedy.
    ///
    /// # Errors
    /// This host cannot send to its network.
    pub fn probe(&self) -> io::Result<Vec<(CameraId, String)>> {
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
        let mut troubles = Vec::new();
        for (id, address) in &self.cameras {
            let mut answer = None;
            for attempt in 0..ATTEMPTS {
                let request = FIRST_ID + attempt;
                socket.send_to(&action(request, self.keys, None), (*address, GVCP_PORT))?;
                answer = receive_until(&socket, Instant::now() + PATIENCE, |bytes, from| {
                    let (answered, status) = action_reply(bytes)?;
                    (from == *address && answered == request).then_some(status)
                })?;
                if answer.is_some() {
                    break;
                }
            }
            let found = match answer {
                Some(ActionStatus::Taken) => continue,
                Some(status) => format!("is answered with {status:?}, expected Taken"),
                None => format!(
                    "has no answer, {ATTEMPTS} times within {} ms: check ActionDeviceKey, ActionGroupKey and \
                     ActionGroupMask \
                     (also in `settings`), and whether a firewall blocks UDP port {GVCP_PORT}",
                    PATIENCE.as_millis()
                ),
            };
            let keys = self.keys;
            let text = format!(
                "an action command with device key {}, group key {} and group mask {:#x} {found}",
                keys.device, keys.group, keys.mask
            );
            troubles.push((id.clone(), text));
        }
        Ok(troubles)
    }
}
