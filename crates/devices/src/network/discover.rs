// SPDX-License-Identifier: MIT OR Apache-2.0
//! Finds cameras by broadcast on every interface, and gives addresses to those in wrong subnets.

use super::gvcp::{self, ForceIp, Reply};
use super::interface::Interface;
use std::fmt;
use std::io;
use std::net::{Ipv4Addr, UdpSocket};
use std::os::fd::AsRawFd;
use std::time::{Duration, Instant};

/// MAC address of a network card, in the lower 48 bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Mac(pub u64);

impl serde::Serialize for Mac {
    fn serialize<S: serde::Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        to.collect_str(self)
    }
}

impl fmt::Display for Mac {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [_, _, a, b, c, d, e, g] = self.0.to_be_bytes();
        write!(f, "{a:02x}:{b:02x}:{c:02x}:{d:02x}:{e:02x}:{g:02x}")
    }
}

/// One camera's answer to a discovery.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Answer {
    /// MAC of the camera's network card.
    pub mac: Mac,
    /// The camera's current IPv4 address.
    pub address: Ipv4Addr,
    /// Name of the manufacturer, as the camera reports it.
    pub vendor: String,
    /// Name of the model, as the camera reports it.
    pub model: String,
    /// Serial number of the camera.
    pub serial: String,
    /// The user-defined name; empty where there is none.
    pub user_name: String,
    /// Name of the interface on which it answered.
    pub interface: String,
}

impl fmt::Display for Answer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { vendor, model, serial, address, mac, .. } = self;
        write!(f, "{vendor} {model} {serial} at {address} ({mac})")
    }
}

impl Answer {
    /// Reads a discovery's payload: the first 0xf8 bytes of the bootstrap registers.
    fn read(payload: &[u8], interface: &str) -> Option<Self> {
        let word = |at: usize| Some(u32::from_be_bytes(*payload.get(at..)?.first_chunk()?));
        let text = |at: usize, length: usize| {
            let bytes = payload.get(at..at + length)?;
            let end = bytes.iter().position(|byte| *byte == 0).unwrap_or(length);
            let text = String::from_utf8_lossy(&bytes[..end]);
            Some(text.chars().filter(|c| !c.is_control()).collect::<String>().trim().to_owned())
        };
        Some(Self {
            mac: Mac(u64::from(word(0x08)? & 0xffff) << 32 | u64::from(word(0x0c)?)),
            address: Ipv4Addr::from_bits(word(0x24)?),
            vendor: text(0x48, 32)?,
            model: text(0x68, 32)?,
            serial: text(0xd8, 16)?,
            user_name: text(0xe8, 16)?,
            interface: interface.to_owned(),
        })
    }
}

/// A socket whose broadcasts leave by this interface, and that also receives answers which are broadcast.
fn socket_on(interface: &Interface) -> io::Result<UdpSocket> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    let name = interface.name.as_bytes();
    // SAFETY: pointer and length describe the name, which outlives the call.
    let bound = unsafe {
        libc::setsockopt(
            socket.as_raw_fd(),
            libc::SOL_SOCKET,
            libc::SO_BINDTODEVICE,
            name.as_ptr().cast(),
            name.len() as libc::socklen_t,
        )
    };
    // Linux before 5.7 requires a capability for that: then the interface's address selects the interface.
    let socket = match (bound, interface.subnets.first()) {
        (0, _) | (_, None) => socket,
        (_, Some(subnet)) => UdpSocket::bind((subnet.address, 0))?,
    };
    socket.set_broadcast(true)?;
    Ok(socket)
}

/// Broadcasts on the interface: to the cameras of its subnets, and to those in none of them.
fn send_to_all(socket: &UdpSocket, interface: &Interface, packet: &[u8]) -> io::Result<()> {
    let own = interface.subnets.iter().map(|subnet| subnet.broadcast());
    let mut sent = Err(io::Error::from(io::ErrorKind::AddrNotAvailable));
    for address in own.chain([Ipv4Addr::BROADCAST]) {
        let one = socket.send_to(packet, (address, gvcp::PORT)).map(drop);
        sent = if sent.is_ok() { sent } else { one };
    }
    sent
}

/// Sends a discovery on every interface and collects answers for `patience`; each camera once, by interface and MAC. An
/// interface that cannot send is left out.
pub fn discover(interfaces: &[Interface], patience: Duration) -> Vec<Answer> {
    const ID: u16 = 0x4d42;
    let send = |interface: &Interface| -> io::Result<UdpSocket> {
        let socket = socket_on(interface)?;
        send_to_all(&socket, interface, &gvcp::discovery(ID))?;
        Ok(socket)
    };
    let sent: Vec<(&Interface, UdpSocket)> =
        interfaces.iter().filter_map(|interface| Some((interface, send(interface).ok()?))).collect();
    let until = Instant::now() + patience;
    let mut found: Vec<Answer> = Vec::new();
    for (interface, socket) in sent {
        // Answers wait in their sockets while others are read; then 20 ms for each socket are enough.
        let until = until.max(Instant::now() + Duration::from_millis(20));
        let collect = |bytes: &[u8], _| -> Option<()> {
            if let Some(Reply::Done(payload)) = gvcp::reply(bytes, ID)
                && let Some(answer) = Answer::read(&payload, &interface.name)
                && !found.iter().any(|known| known.mac == answer.mac)
            {
                found.push(answer);
            }
            None
        };
        if let Err(error) = gvcp::receive_until(&socket, until, collect) {
            tracing::warn!(interface = interface.name, %error, "answers to the discovery cannot be read");
        }
    }
    found.sort_by_key(|answer| (answer.interface.clone(), answer.mac));
    found
}

/// Gives a camera an address, which it keeps until its power is switched off, and waits for its answer for at most
/// `patience`. [`discover`] then shows whether the camera has the address.
///
/// # Errors
/// The system refuses to send or to receive.
pub fn force_address(interface: &Interface, force: &ForceIp, patience: Duration) -> io::Result<()> {
    const ID: u16 = 0x4d43;
    let socket = socket_on(interface)?;
    send_to_all(&socket, interface, &gvcp::force_ip(ID, force))?;
    let is_done = |bytes: &[u8], _| matches!(gvcp::reply(bytes, ID), Some(Reply::Done(_))).then_some(());
    gvcp::receive_until(&socket, Instant::now() + patience, is_done).map(drop)
}

#[cfg(test)]
mod tests {
    use super::{Answer, Mac};

    #[test]
    fn an_answer_is_read_from_the_bootstrap_registers() {
        let mut payload = vec![0; 0xf8];
        payload[0x08..0x10].copy_from_slice(&[0, 0, 0x00, 0x30, 0x53, 0x01, 0x02, 0x03]);
        payload[0x24..0x28].copy_from_slice(&[169, 254, 3, 3]);
        payload[0x48..0x4e].copy_from_slice(b"Basler");
        payload[0xd8..0xdc].copy_from_slice(b"4\x1b12");
        let answer = Answer::read(&payload, "cam0").expect("whole");
        assert_eq!(answer.mac, Mac(0x0030_5301_0203));
        assert_eq!(answer.to_string(), "Basler  412 at 169.254.3.3 (00:30:53:01:02:03)");
        assert_eq!(Answer::read(&payload[..0xf0], "cam0"), None, "cut");
    }
}
