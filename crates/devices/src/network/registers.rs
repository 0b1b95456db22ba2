// SPDX-License-Identifier: MIT OR Apache-2.0
//! The registers of a GigE Vision camera with the address that it has after its power was switched off.

use super::gvcp::{self, Reply};
use super::interface::Subnet;
use std::io;
use std::net::{Ipv4Addr, UdpSocket};
use std::time::{Duration, Instant};

/// Register with the IP configuration of the first interface (GigE Vision bootstrap).
const CONFIGURATION: u32 = 0x0014;
const PERSISTENT_ADDRESS: u32 = 0x064c;
const PERSISTENT_MASK: u32 = 0x065c;
const PERSISTENT_GATEWAY: u32 = 0x066c;
const PRIVILEGE: u32 = 0x0a00;

/// Bit of the configuration: the camera uses its persistent address.
const PERSISTENT: u32 = 1;
/// Bit of the configuration: the camera requests an address by DHCP.
const DHCP: u32 = 2;
/// Value of the privilege register that takes control of the camera.
const CONTROL: u32 = 2;

/// Longest wait for one answer; a camera answers within a few milliseconds.
const PATIENCE: Duration = Duration::from_millis(500);
/// How often a command is sent, because UDP packets may get lost.
const ATTEMPTS: usize = 3;
/// Longest wait for an answer that the camera has announced as pending.
const PENDING_PATIENCE: Duration = Duration::from_secs(3);

/// The address that a camera has after its power was switched off.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum KeptAddress {
    /// A persistent address, which is this one.
    Kept(Ipv4Addr),
    /// An address by DHCP, or one of its own choice in 169.254.0.0/16.
    Any,
}

/// A control channel (GVCP), at first without control of the camera.
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
        for _ in 0..ATTEMPTS {
            self.socket.send(&packet(id))?;
            let mut until = Instant::now() + PATIENCE;
            loop {
                match gvcp::receive_until(&self.socket, until, |bytes, _| gvcp::reply(bytes, id))? {
                    Some(Reply::Done(payload)) => return Ok(payload),
                    Some(Reply::Refused(status)) => {
                        let refused = format!("the camera refuses the command (GVCP status 0x{status:04x})");
                        return Err(io::Error::other(refused));
                    }
                    Some(Reply::Pending) => until = Instant::now() + PENDING_PATIENCE,
                    None => break,
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

/// Reads the persistent address of the camera at `address`.
///
/// # Errors
/// The camera does not answer, or has no such registers.
pub fn read_kept_address(address: Ipv4Addr) -> io::Result<KeptAddress> {
    let mut channel = Channel::open(address)?;
    match channel.read(CONFIGURATION)? & PERSISTENT {
        0 => Ok(KeptAddress::Any),
        _ => Ok(KeptAddress::Kept(Ipv4Addr::from_bits(channel.read(PERSISTENT_ADDRESS)?))),
    }
}

/// Makes the current address of a camera persistent.
///
/// # Errors
/// Another program controls the camera, it refuses, or it does not answer.
pub fn keep_address(subnet: Subnet) -> io::Result<()> {
    let mut channel = Channel::open(subnet.address)?;
    channel.write(PRIVILEGE, CONTROL)?;
    let kept = [
        (PERSISTENT_ADDRESS, subnet.address.to_bits()),
        (PERSISTENT_MASK, subnet.mask().to_bits()),
        (PERSISTENT_GATEWAY, 0),
    ];
    let write = |channel: &mut Channel| {
        kept.iter().try_for_each(|(register, value)| channel.write(*register, *value))?;
        let now = channel.read(CONFIGURATION)?;
        channel.write(CONFIGURATION, now & !DHCP | PERSISTENT)
    };
    let done = write(&mut channel);
    // Control is released also after a failure, so that the next program need not wait for the heartbeat timeout.
    let released = channel.write(PRIVILEGE, 0);
    done.and(released)?;
    match read_kept_address(subnet.address)? {
        KeptAddress::Kept(kept) if kept == subnet.address => Ok(()),
        other => {
            Err(io::Error::other(format!("the camera has {other:?} after {} was written", subnet.address)))
        }
    }
}
