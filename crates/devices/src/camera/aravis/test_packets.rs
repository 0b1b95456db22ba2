// SPDX-License-Identifier: MIT OR Apache-2.0
//! Has a GigE camera send test packets, and receives them.

use super::device_features::is_silence;
use super::{AravisCamera, checked, link_error};
use crate::camera::features::{Failed, Features as _};
use crate::camera::packet_test::{self, LARGEST, PATIENCE, Sizes, Tried};
use crate::camera::{CameraError, PacketTest};
use aravis::prelude::*;
use std::io;
use std::net::{IpAddr, Ipv4Addr, UdpSocket};
use std::time::{Duration, Instant};

/// Bootstrap registers: the camera's address, and of its first stream the port, the packet size and the address it goes to.
const OWN_ADDRESS: u64 = 0x0024;
const HOST_PORT: u64 = 0x0d00;
const PACKET_SIZE: u64 = 0x0d04;
const DESTINATION: u64 = 0x0d18;
/// Of the packet size: one test packet now; packets must not be cut into pieces on their way; the size.
const FIRE: u32 = 1 << 31;
const WHOLE: u32 = 1 << 30;
const SIZE: u32 = 0xffff;
/// Where a camera listens.
const CONTROL_PORT: u16 = 3956;
/// IP and UDP headers, which the size counts in.
const HEADERS: usize = 28;
/// Packets of one size, until one arrives.
const TRIES: usize = 3;

const DOING: &str = "testing the packet size";

/// A camera's test packets.
struct Tests<'a> {
    camera: &'a AravisCamera,
    socket: UdpSocket,
    from: IpAddr,
    /// What the register had beside the size.
    others: u32,
    buffer: Vec<u8>,
}

fn on_this_host(error: &io::Error) -> CameraError {
    CameraError::Link { doing: DOING, detail: format!("no socket for its packets: {error}") }
}

/// A socket by which this host is reached from the camera's network.
fn socket_towards(camera: Ipv4Addr) -> io::Result<(UdpSocket, Ipv4Addr)> {
    let way = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    way.connect((camera, CONTROL_PORT))?;
    let IpAddr::V4(own) = way.local_addr()?.ip() else {
        return Err(io::Error::other("the camera is not reached by IPv4"));
    };
    Ok((UdpSocket::bind((own, 0))?, own))
}

impl AravisCamera {
    /// See [`crate::camera::Camera::test_packet_size`].
    pub(super) fn test_packets(&self, asked: u32) -> Result<Option<PacketTest>, CameraError> {
        let error = link_error(DOING);
        let from = Ipv4Addr::from_bits(checked::register(&self.device, OWN_ADDRESS).map_err(&error)?);
        let (socket, own) = socket_towards(from).map_err(|e| on_this_host(&e))?;
        let port = socket.local_addr().map_err(|e| on_this_host(&e))?.port();
        let others = checked::register(&self.device, PACKET_SIZE).map_err(&error)? & !(FIRE | SIZE);
        let mut tests = Tests { camera: self, socket, from: from.into(), others, buffer: vec![0; 1 << 16] };
        tests.set(DESTINATION, own.to_bits())?;
        tests.set(HOST_PORT, u32::from(port))?;
        let found =
            packet_test::largest(asked, self.packet_sizes(), |size, patience| tests.attempt(size, patience));
        if let Ok(Some(found)) = found {
            tests.set(PACKET_SIZE, tests.others | found.arrived & SIZE)?;
        }
        self.close_stream_channel();
        match found? {
            Some(found) => Ok(Some(found)),
            // Not every camera has such packets, and then its own description does not name them.
            None if !self.has("GevSCPSFireTestPacket") => Ok(None),
            None => Err(CameraError::NoTestPackets { patience_ms: PATIENCE.as_millis() * TRIES as u128 }),
        }
    }

    /// The packet sizes that its description allows; any where it says nothing that has sense.
    fn packet_sizes(&self) -> Sizes {
        const FEATURE: &str = "GevSCPSPacketSize";
        let limits = checked::integer_bounds(&self.device, FEATURE).unwrap_or((i64::MIN, i64::MAX));
        let step = self.device.integer_feature_increment(FEATURE).unwrap_or(1);
        let size = |limit: i64| u32::try_from(limit.clamp(0, i64::from(LARGEST))).unwrap_or(LARGEST);
        let (min, max) = (size(limits.0), size(limits.1));
        match min <= max && max > 0 {
            true => Sizes { min, max, step: size(step).max(1) },
            false => Sizes { min: 0, max: LARGEST, step: 1 },
        }
    }
}

impl Tests<'_> {
    /// Writes a register; whether the camera took it.
    fn set(&self, register: u64, value: u32) -> Result<bool, CameraError> {
        match self.camera.device.write_register(register, value) {
            Ok(_) => Ok(true),
            Err(error) => match self.camera.not_set(&error) {
                Failed::Lost(error) => Err(error),
                Failed::Refused(_) | Failed::Nonsense(_) => Ok(false),
            },
        }
    }

    fn attempt(&mut self, asked: u32, patience: Duration) -> Result<Tried, CameraError> {
        let refused = Tried { size: None, arrived: None, took: Duration::ZERO };
        if !self.set(PACKET_SIZE, self.others | WHOLE | asked & SIZE)? {
            return Ok(refused);
        }
        let size = match checked::register(&self.camera.device, PACKET_SIZE) {
            Ok(value) => value & SIZE,
            Err(error) if is_silence(&error) => return Err(link_error(DOING)(error)),
            Err(_) => asked,
        };
        let begun = Instant::now();
        for _ in 0..TRIES {
            if !self.set(PACKET_SIZE, self.others | FIRE | WHOLE | size)? {
                return Ok(refused);
            }
            let arrived = self.receive(size, Instant::now() + patience).map_err(|e| on_this_host(&e))?;
            if arrived.is_some() {
                return Ok(Tried { size: Some(size), arrived, took: begun.elapsed() });
            }
        }
        Ok(Tried { size: Some(size), arrived: None, took: begun.elapsed() })
    }

    /// The largest of the camera's packets that come until then; what is as large as was asked ends it.
    fn receive(&mut self, size: u32, until: Instant) -> io::Result<Option<u32>> {
        let mut largest = None;
        loop {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(largest);
            }
            self.socket.set_read_timeout(Some(left))?;
            let Ok((length, from)) = self.socket.recv_from(&mut self.buffer) else { continue };
            if from.ip() != self.from {
                continue;
            }
            let bytes = u32::try_from(length + HEADERS).unwrap_or(LARGEST);
            largest = largest.max(Some(bytes));
            if bytes + packet_test::ROUNDED >= size {
                return Ok(largest);
            }
        }
    }
}
