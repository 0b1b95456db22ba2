// SPDX-License-Identifier: MIT OR Apache-2.0
//! Discovery by broadcast: every camera hears broadcasts on loopback and answers from its own address.

use super::gvcp::{self, Command, Request};
use super::net::{BROADCASTS, bind_shared};
use super::registers::Registers;
use std::net::{SocketAddrV4, UdpSocket};

/// Sockets that hear broadcasts. All cameras of all processes share the addresses; where one cannot be
/// bound, the camera warns and is found by its own address only.
pub fn sockets() -> Vec<UdpSocket> {
    let mut sockets = Vec::with_capacity(BROADCASTS.len());
    for address in BROADCASTS {
        let address = SocketAddrV4::new(address, gvcp::PORT);
        let bound = bind_shared(address).and_then(|s| s.set_nonblocking(true).map(|()| s));
        match bound {
            Ok(socket) => sockets.push(socket),
            Err(error) => {
                tracing::warn!(%address, %error, "discovery by broadcast will not find this camera")
            }
        }
    }
    sockets
}

/// The answer to a broadcast datagram, where it is a discovery from this host. Others cannot reach loopback
/// addresses, so an answer would only confuse them.
pub fn answer(datagram: &[u8], from: SocketAddrV4, registers: &Registers) -> Option<Vec<u8>> {
    let request = Request::decode(datagram).ok()?;
    let due = request.command == Command::Discovery && from.ip().is_loopback();
    due.then(|| gvcp::discovery_ack(request.id, &registers.discovery()))
}

/// Whether it gives a camera of this host an address.
pub fn forces_ip(datagram: &[u8], from: SocketAddrV4) -> bool {
    let request = Request::decode(datagram);
    from.ip().is_loopback() && matches!(request, Ok(Request { command: Command::ForceIp(_), .. }))
}
