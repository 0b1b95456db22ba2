// SPDX-License-Identifier: MIT OR Apache-2.0
//! Another client on the cameras' network: real datagrams from an address of its own, to the control channel and to
//! the node's stream port.

use super::gvcp::{self, Command, Request};
use super::gvsp::{self, IdMode, Layout, PayloadHeaders};
use super::map::Id;
use super::transmit::Frame;
use super::{Statistics, control};
use crate::faults::{Fault, Kind};
use crate::random::hash;
use std::io;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

/// The foreign client of one camera.
#[derive(Debug)]
pub struct Rogue {
    socket: UdpSocket,
    /// At the camera's own address: a program of the same machine, or one that forges the address.
    same_address: UdpSocket,
    camera: SocketAddrV4,
    statistics: Arc<Statistics>,
    next_id: u16,
    /// The request with which it gave its own control back.
    left: Option<u16>,
}

/// Command acknowledges of writes: the only ones that tell whether a stranger was obeyed.
const WRITE_ACKS: [u16; 2] = [0x0083, 0x0087];

impl Rogue {
    /// At an address that is neither the node's nor a camera's: that of the camera in the network 127.254.
    ///
    /// # Errors
    /// What the system says.
    pub fn new(camera: Ipv4Addr, statistics: Arc<Statistics>) -> io::Result<Self> {
        let [_, _, c, d] = camera.octets();
        let socket = UdpSocket::bind((Ipv4Addr::new(127, 254, c, d), 0))?;
        socket.set_nonblocking(true)?;
        let same_address = UdpSocket::bind((camera, 0))?;
        let camera = SocketAddrV4::new(camera, gvcp::PORT);
        Ok(Self { socket, same_address, camera, statistics, next_id: 1, left: None })
    }

    /// The client's own address and port.
    pub fn address(&self) -> Option<SocketAddrV4> {
        match self.socket.local_addr() {
            Ok(SocketAddr::V4(address)) => Some(address),
            _ => None,
        }
    }

    fn tell(&mut self, command: Command) {
        let id = self.next_id;
        self.next_id = id.checked_add(1).unwrap_or(1);
        // What does not arrive was not said.
        let _ = self.socket.send_to(&Request { id, ack: true, command }.encode(), self.camera);
    }

    /// Tries everything that only a controller may do, and some things that anybody may.
    pub fn harass(&mut self, fault: Fault) {
        self.look_at_answers();
        let privilege = Id::Privilege.address();
        self.tell(Command::WriteRegisters(vec![(privilege, control::CONTROL)]));
        self.tell(Command::WriteRegisters(vec![(privilege, control::EXCLUSIVE)]));
        self.tell(Command::WriteRegisters(vec![(privilege, 0)]));
        self.tell(Command::WriteRegisters(vec![(Id::AcquisitionStop.address(), 1)]));
        self.tell(Command::WriteMemory { address: privilege, data: vec![0, 0, 0, 2] });
        self.tell(Command::Discovery);
        self.tell(Command::ReadRegisters(vec![privilege]));
        for (number, length) in [0usize, 1, 7, 8, 9, 600, 1500].into_iter().enumerate() {
            let noise = (0..length).map(|k| hash(fault.chance, &[number as u64, k as u64]) as u8);
            let _ = self.socket.send_to(&noise.collect::<Vec<_>>(), self.camera);
        }
    }

    /// Counts what has been answered to its writes.
    pub fn look_at_answers(&mut self) {
        let mut answer = [0; 1024];
        while let Ok(length) = self.socket.recv(&mut answer) {
            let word = |at: usize| {
                let bytes = answer.get(..length)?.get(at..at + 2)?;
                Some(u16::from_be_bytes([bytes[0], bytes[1]]))
            };
            let own = self.left.is_some() && word(6) == self.left;
            if !own && word(2).is_some_and(|command| WRITE_ACKS.contains(&command)) {
                let obeyed = word(0) == Some(gvcp::Status::Success as u16);
                let counter = if obeyed {
                    &self.statistics.strangers_obeyed
                } else {
                    &self.statistics.strangers_refused
                };
                counter.fetch_add(1, Relaxed);
            }
        }
    }

    /// A sign of life of a client that has control.
    pub fn heartbeat(&mut self) {
        self.tell(Command::ReadRegisters(vec![Id::Privilege.address()]));
    }

    /// Gives the control privilege of the camera back.
    pub fn leave(&mut self) {
        self.left = Some(self.next_id);
        self.tell(Command::WriteRegisters(vec![(Id::Privilege.address(), 0)]));
    }

    /// Sends stream packets that belong to no frame of the camera to where its frames go.
    pub fn stray(&self, frame: &Frame, fault: Fault, destination: SocketAddrV4) {
        let from: &[&UdpSocket] = match fault.kind {
            Kind::ForeignPixels => &[&self.same_address],
            Kind::ForeignSmall => &[&self.same_address, &self.socket],
            _ => &[&self.socket],
        };
        for packet in stray_packets(frame, fault) {
            for socket in from {
                let _ = socket.send_to(&packet, destination);
            }
        }
    }
}

fn later_id(ids: IdMode, id: u64, by: u64) -> u64 {
    match ids {
        IdMode::Standard => (id - 1 + by) % 0xffff + 1,
        IdMode::Extended => id.wrapping_add(by).max(1),
    }
}

fn stray_packets(frame: &Frame, fault: Fault) -> Vec<Vec<u8>> {
    let layout: &Layout = &frame.layout;
    let payload_at = |block_id: u64, id: u32| {
        let mut headers = PayloadHeaders::new(layout);
        headers.stamp(block_id);
        let mut packet = headers.get(id).to_vec();
        packet.resize(packet.len() + layout.range(id).len(), 0xa5);
        packet
    };
    let payload = |block_id: u64| payload_at(block_id, 1);
    if fault.kind == Kind::ForeignPixels {
        let stamp = frame.timestamp.wrapping_add(1_000_000_000);
        let leader = gvsp::leader(layout, gvsp::Status::Ok, frame.block_id, stamp);
        let pixels = (1..=layout.payload_packets()).map(|id| payload_at(frame.block_id, id));
        return std::iter::once(leader).chain(pixels).collect();
    }
    if fault.kind == Kind::ForeignSmall {
        // Bytes in which an id can be read are among them.
        let noise = |n: u64| (0..4 * n).map(move |k| hash(fault.chance, &[n, k]) as u8).collect();
        return (0..8).map(noise).collect();
    }
    if fault.kind == Kind::ForeignAhead {
        return vec![payload(later_id(layout.ids, frame.block_id, fault.count))];
    }
    // Further away than what a receiver takes for a late or an early frame, by any reckoning.
    let far =
        |number: u64| later_id(layout.ids, frame.block_id, 20_000 + hash(fault.chance, &[number]) % 20_000);
    let leader = gvsp::leader(layout, gvsp::Status::Ok, far(0), hash(fault.chance, &[9]) >> 2);
    vec![leader, payload(far(1)), gvsp::trailer(layout, gvsp::Status::Ok, far(2))]
}

#[cfg(test)]
mod tests {
    use super::later_id;
    use crate::gige::gvsp::IdMode;

    #[test]
    fn ids_wrap_around_and_are_never_zero() {
        assert_eq!(later_id(IdMode::Standard, 0xffff, 1), 1);
        assert_eq!(later_id(IdMode::Standard, 0xfffe, 1), 0xffff);
        assert_eq!(later_id(IdMode::Standard, 1, 0xffff), 1);
        assert_eq!(later_id(IdMode::Extended, 0xffff, 1), 0x10000);
    }
}
