// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether every camera answers an action command with its keys, asked before a session: no camera acquires then.

use super::ActionSetup;
use crate::base::ids::CameraId;
use crate::network::{ActionStatus, GVCP_PORT, action, action_reply};
use std::io;
use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::time::{Duration, Instant};

/// An answer comes within this, or the packet was lost.
const PATIENCE: Duration = Duration::from_millis(200);
/// A packet may get lost.
const ATTEMPTS: u16 = 3;
/// Ids that no trigger near the beginning of a session has.
const FIRST_ID: u16 = 0x8000;

impl ActionSetup {
    /// Sends each camera one action that is done at once; gives those that do not take it, with what to do.
    ///
    /// # Errors
    /// This host's network refuses.
    pub fn probe(&self) -> io::Result<Vec<(CameraId, String)>> {
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
        let mut troubles = Vec::new();
        for (id, address) in &self.cameras {
            let mut answer = None;
            for attempt in 0..ATTEMPTS {
                let request = FIRST_ID + attempt;
                socket.send_to(&action(request, self.keys, None), (*address, GVCP_PORT))?;
                answer = wait(&socket, *address, request)?;
                if answer.is_some() {
                    break;
                }
            }
            let keys = self.keys;
            let sent = format!(
                "an action command with device key {}, group key {} and group mask {:#x}",
                keys.device, keys.group, keys.mask
            );
            match answer {
                Some(ActionStatus::Taken) => {}
                Some(status) => troubles.push((id.clone(), format!("{sent} is answered {status:?}, expected Taken"))),
                None => troubles.push((
                    id.clone(),
                    format!(
                        "{sent} is not answered, {ATTEMPTS} times within {} ms: ActionDeviceKey, ActionGroupKey or \
                         ActionGroupMask is otherwise (in `settings`?), or the network keeps UDP port {GVCP_PORT} from it",
                        PATIENCE.as_millis()
                    ),
                )),
            }
        }
        Ok(troubles)
    }
}

fn wait(socket: &UdpSocket, from: Ipv4Addr, id: u16) -> io::Result<Option<ActionStatus>> {
    let until = Instant::now() + PATIENCE;
    let mut buffer = [0; 64];
    loop {
        let left = until.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Ok(None);
        }
        socket.set_read_timeout(Some(left))?;
        match socket.recv_from(&mut buffer) {
            Ok((length, SocketAddr::V4(sender))) if *sender.ip() == from => {
                if let Some((_, status)) =
                    action_reply(&buffer[..length]).filter(|(answered, _)| *answered == id)
                {
                    return Ok(Some(status));
                }
            }
            Ok(_) => {}
            Err(error) if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) => {}
            // Its host says that nobody listens.
            Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => return Ok(None),
            Err(error) => return Err(error),
        }
    }
}
