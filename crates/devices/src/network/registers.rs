// SPDX-License-Identifier: MIT OR Apache-2.0
//! The registers of a GigE Vision camera that say which address it has after its power was switched off.

use super::gvcp::{self, Reply};
use super::interface::Subnet;
use std::io;
use std::net::{Ipv4Addr, UdpSocket};
use std::time::{Duration, Instant};

/// Bootstrap registers of the first interface.
const CONFIGURATION: u32 = 0x0014;
const PERSISTENT_ADDRESS: u32 = 0x064c;
const PERSISTENT_MASK: u32 = 0x065c;
const PERSISTENT_GATEWAY: u32 = 0x066c;
const PRIVILEGE: u32 = 0x0a00;

/// Configuration: it keeps an address; it asks for one by DHCP.
const PERSISTENT: u32 = 1;
const DHCP: u32 = 2;
/// Privilege: control.
const CONTROL: u32 = 2;

/// For one answer, and how often to ask.
const PATIENCE: Duration = Duration::from_millis(500);
const ATTEMPTS: usize = 3;
/// An answer that was announced comes within this.
const PENDING_PATIENCE: Duration = Duration::from_secs(3);

/// Which address a camera has after its power was switched off.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum KeptAddress {
    /// This one.
    Kept(Ipv4Addr),
    /// What it is given by DHCP, or one of its own choice in 169.254.0.0/16.
    Any,
}

/// A control channel, without control of the camera.
struct Channel {
    socket: UdpSocket,
    next: u16,
}

impl Channel {
    fn open(address: Ipv4Addr) -> io::Result<Self> {
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
        socket.connect((address, gvcp::PORT))?;
        Ok(Self { socket, next: 1 })
    }

    fn ask(&mut self, packet: impl Fn(u16) -> Vec<u8>) -> io::Result<Vec<u8>> {
        let id = self.next;
        self.next = self.next.wrapping_add(1).max(1);
        let mut buffer = [0; 1024];
        for _ in 0..ATTEMPTS {
            self.socket.send(&packet(id))?;
            let mut until = Instant::now() + PATIENCE;
            loop {
                let left = until.saturating_duration_since(Instant::now());
                if left.is_zero() {
                    break;
                }
                self.socket.set_read_timeout(Some(left))?;
                let Ok(length) = self.socket.recv(&mut buffer) else { continue };
                match gvcp::reply(&buffer[..length], id) {
                    Some(Reply::Done(payload)) => return Ok(payload.to_vec()),
                    Some(Reply::Refused(status)) => {
                        return Err(io::Error::other(format!(
                            "the camera refuses it (status 0x{status:04x})"
                        )));
                    }
                    Some(Reply::Pending) => until = Instant::now() + PENDING_PATIENCE,
                    None => {}
                }
            }
        }
        Err(io::Error::new(io::ErrorKind::TimedOut, "the camera does not answer"))
    }

    fn read(&mut self, register: u32) -> io::Result<u32> {
        let payload = self.ask(|id| gvcp::read_register(id, register))?;
        let bytes = payload.first_chunk().ok_or_else(|| io::Error::other("the camera's answer is cut"))?;
        Ok(u32::from_be_bytes(*bytes))
    }

    fn write(&mut self, register: u32, value: u32) -> io::Result<()> {
        self.ask(|id| gvcp::write_register(id, register, value)).map(drop)
    }
}

/// Which address the camera at `address` keeps.
///
/// # Errors
/// It does not answer, or has no such registers.
pub fn read_kept_address(address: Ipv4Addr) -> io::Result<KeptAddress> {
    let mut channel = Channel::open(address)?;
    match channel.read(CONFIGURATION)? & PERSISTENT {
        0 => Ok(KeptAddress::Any),
        _ => Ok(KeptAddress::Kept(Ipv4Addr::from_bits(channel.read(PERSISTENT_ADDRESS)?))),
    }
}

/// Has the camera at this address keep it.
///
/// # Errors
/// Another program controls it, it refuses, or it does not answer.
pub fn keep_address(subnet: Subnet) -> io::Result<()> {
    let mut channel = Channel::open(subnet.address)?;
    channel.write(PRIVILEGE, CONTROL)?;
    let kept = [
        (PERSISTENT_ADDRESS, subnet.address.to_bits()),
        (PERSISTENT_MASK, subnet.mask().to_bits()),
        (PERSISTENT_GATEWAY, 0),
    ];
    let mut done = kept.iter().try_for_each(|(register, value)| channel.write(*register, *value));
    done = done.and_then(|()| {
        let now = channel.read(CONFIGURATION)?;
        channel.write(CONFIGURATION, now & !DHCP | PERSISTENT)
    });
    // Given back whatever came of it: the next program must not wait for a heartbeat.
    let given_back = channel.write(PRIVILEGE, 0);
    done.and(given_back)?;
    match read_kept_address(subnet.address)? {
        KeptAddress::Kept(kept) if kept == subnet.address => Ok(()),
        other => {
            Err(io::Error::other(format!("the camera has {other:?} after {} was written", subnet.address)))
        }
    }
}
