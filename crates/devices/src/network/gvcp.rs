// SPDX-License-Identifier: MIT OR Apache-2.0
//! The packets of GVCP, the GigE Vision control protocol, that find cameras and give them addresses.
//!
//! A command is an 8-byte header (key 0x42, flags, command, length, request id) and its payload; an acknowledge is
//! status, command + 1, length, request id, payload. All big-endian (GigE Vision 2.x, part 2).

use std::io;
use std::net::{IpAddr, Ipv4Addr, UdpSocket};
use std::time::Instant;

/// UDP port on which every GigE Vision device listens.
pub const PORT: u16 = 3956;

const KEY: u8 = 0x42;
/// Flag of a command: the device shall acknowledge it.
pub(super) const ACKNOWLEDGE: u8 = 0x01;
/// Flag of a discovery: a device in another subnet may broadcast its answer.
const BY_BROADCAST: u8 = 0x10;

const DISCOVERY: u16 = 0x0002;
const FORCE_IP: u16 = 0x0004;
const READ_REGISTER: u16 = 0x0080;
const WRITE_REGISTER: u16 = 0x0082;
/// Code of an answer that announces a later one.
const PENDING: u16 = 0x0089;

/// A device's new address, which it keeps until its power is switched off.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ForceIp {
    /// MAC of the device, the lower 48 bits.
    pub mac: u64,
    /// The new IPv4 address of the device.
    pub address: Ipv4Addr,
    /// The mask of the new subnet.
    pub mask: Ipv4Addr,
}

pub(super) fn command(code: u16, flags: u8, id: u16, payload: &[u8]) -> Vec<u8> {
    let length = u16::try_from(payload.len()).unwrap_or(u16::MAX);
    let mut bytes = vec![KEY, flags];
    [code, length, id].iter().for_each(|word| bytes.extend(word.to_be_bytes()));
    bytes.extend(payload);
    bytes
}

/// A discovery command, which every camera answers.
pub fn discovery(id: u16) -> Vec<u8> {
    command(DISCOVERY, ACKNOWLEDGE | BY_BROADCAST, id, &[])
}

/// A command that gives the camera with this MAC an address.
pub fn force_ip(id: u16, force: &ForceIp) -> Vec<u8> {
    let mut payload = force.mac.to_be_bytes().to_vec();
    for word in [force.address, force.mask, Ipv4Addr::UNSPECIFIED] {
        payload.extend([0; 12]);
        payload.extend(word.octets());
    }
    command(FORCE_IP, ACKNOWLEDGE, id, &payload)
}

/// A command that reads a register of 32 bits.
pub fn read_register(id: u16, address: u32) -> Vec<u8> {
    command(READ_REGISTER, ACKNOWLEDGE, id, &address.to_be_bytes())
}

/// A command that writes a register of 32 bits.
pub fn write_register(id: u16, address: u32, value: u32) -> Vec<u8> {
    command(WRITE_REGISTER, ACKNOWLEDGE, id, &[address.to_be_bytes(), value.to_be_bytes()].concat())
}

/// A camera's answer to a command.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Reply {
    /// The command was carried out; the payload of the answer.
    Done(Vec<u8>),
    /// The camera refuses the command with this GVCP status.
    Refused(u16),
    /// The camera needs more time, and will answer again.
    Pending,
}

/// The header of an acknowledge: status, command + 1, length of the payload, request id.
pub(super) fn header(datagram: &[u8]) -> Option<[u16; 4]> {
    let word = |at: usize| Some(u16::from_be_bytes(*datagram.get(at..)?.first_chunk()?));
    Some([word(0)?, word(2)?, word(4)?, word(6)?])
}

/// The answer to request `id`; `None` for any other datagram.
pub fn reply(datagram: &[u8], id: u16) -> Option<Reply> {
    let [status, code, length, of] = header(datagram)?;
    let payload = datagram.get(8..8 + usize::from(length))?;
    let is_answer =
        [DISCOVERY, FORCE_IP, READ_REGISTER, WRITE_REGISTER].iter().any(|command| code == command + 1);
    match (of == id, code) {
        (true, PENDING) => Some(Reply::Pending),
        (true, _) if is_answer && status == 0 => Some(Reply::Done(payload.to_vec())),
        (true, _) if is_answer => Some(Reply::Refused(status)),
        _ => None,
    }
}

/// Receives datagrams until `until`, or until `take` accepts one. Reports of the network that a packet did not reach
/// its host are skipped: the answer that is waited for may still come.
pub fn receive_until<T>(
    socket: &UdpSocket,
    until: Instant,
    mut take: impl FnMut(&[u8], IpAddr) -> Option<T>,
) -> io::Result<Option<T>> {
    use io::ErrorKind::{
        ConnectionRefused, HostUnreachable, Interrupted, NetworkUnreachable, TimedOut, WouldBlock,
    };
    let mut buffer = vec![0; 1 << 16];
    loop {
        let left = until.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Ok(None);
        }
        socket.set_read_timeout(Some(left))?;
        match socket.recv_from(&mut buffer) {
            Ok((length, from)) => {
                if let Some(taken) = take(&buffer[..length], from.ip()) {
                    return Ok(Some(taken));
                }
            }
            Err(error)
                if matches!(
                    error.kind(),
                    WouldBlock
                        | TimedOut
                        | Interrupted
                        | ConnectionRefused
                        | HostUnreachable
                        | NetworkUnreachable
                ) => {}
            Err(error) => return Err(error),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{ForceIp, Reply, discovery, force_ip, read_register, reply, write_register};
    use proptest::prelude::*;

    /// The bytes of GigE Vision 2.0, tables 16-1 to 16-4.
    #[test]
    fn packets_have_the_bytes_of_the_standard() {
        assert_eq!(discovery(7), [0x42, 0x11, 0, 2, 0, 0, 0, 7]);
        assert_eq!(read_register(1, 0x0a00), [0x42, 1, 0, 0x80, 0, 4, 0, 1, 0, 0, 0x0a, 0]);
        assert_eq!(write_register(2, 0x0a00, 2), [0x42, 1, 0, 0x82, 0, 8, 0, 2, 0, 0, 0x0a, 0, 0, 0, 0, 2]);
        let force = ForceIp {
            mac: 0x0011_2233_4455,
            address: [192, 168, 10, 2].into(),
            mask: [255, 255, 255, 0].into(),
        };
        let bytes = force_ip(3, &force);
        assert_eq!(bytes.len(), 8 + 56);
        assert_eq!(&bytes[8..16], [0, 0, 0, 0x11, 0x22, 0x33, 0x44, 0x55]);
        assert_eq!((&bytes[28..32], &bytes[44..48]), (&[192, 168, 10, 2][..], &[255, 255, 255, 0][..]));
    }

    #[test]
    fn an_answer_is_distinguished_from_others() {
        assert_eq!(reply(&[0, 0, 0, 0x81, 0, 4, 0, 9, 1, 2, 3, 4], 9), Some(Reply::Done(vec![1, 2, 3, 4])));
        assert_eq!(reply(&[0x80, 6, 0, 0x83, 0, 0, 0, 9], 9), Some(Reply::Refused(0x8006)));
        assert_eq!(reply(&[0, 0, 0, 0x89, 0, 4, 0, 9, 0, 0, 0, 100], 9), Some(Reply::Pending));
        assert_eq!(reply(&[0, 0, 0, 0x81, 0, 0, 0, 8], 9), None, "of another request");
        assert_eq!(reply(&[0, 0, 0, 0x81, 0, 4, 0, 9, 1], 9), None, "cut");
    }

    proptest! {
        #[test]
        fn no_datagram_panics(bytes in prop::collection::vec(any::<u8>(), 0..80), id: u16) {
            prop_assert!(bytes.len() >= 8 || reply(&bytes, id).is_none());
        }
    }
}
