// SPDX-License-Identifier: MIT OR Apache-2.0
//! Makes a GigE camera send test packets, and receives them.

use super::device_features::is_silence;
use super::registers::{DESTINATION, HOST_PORT, OWN_ADDRESS, PACKET_SIZE};
use super::{AravisCamera, checked, link_error};
use crate::camera::backend::PacketTest;
use crate::camera::error::CameraError;
use crate::camera::features::{Features as _, answered};
use crate::camera::packet_size::FEATURE;
use crate::camera::packet_test::{self, LARGEST, PATIENCE, Sizes, Tried};
use crate::network::{GVCP_PORT, receive_until};
use aravis::prelude::*;
use std::io;
use std::net::{IpAddr, Ipv4Addr, UdpSocket};
use std::time::{Duration, Instant};

/// Bit of the packet size that sends one test packet now.
const FIRE: u32 = 1 << 31;
/// Bit of the packet size that forbids to fragment packets on their way.
const WHOLE: u32 = 1 << 30;
/// Bits of the packet size that hold the size, bytes.
const SIZE: u32 = 0xffff;
/// Bytes of the IP and UDP headers, which are part of the size.
const HEADERS: usize = 28;
/// Test packets of one size before it counts as lost.
const TRIES: usize = 3;

const DOING: &str = "testing the packet size";

/// A test of packet sizes under way.
struct Tests<'a> {
    camera: &'a AravisCamera,
    socket: UdpSocket,
    from: IpAddr,
    /// The other bits of the packet-size register.
    others: u32,
}

fn on_this_host(error: &io::Error) -> CameraError {
    CameraError::Link { doing: DOING, detail: format!("no socket for its packets: {error}") }
}

/// A socket on the address by which the camera reaches this host, and that address.
fn socket_towards(camera: Ipv4Addr) -> io::Result<(UdpSocket, Ipv4Addr)> {
    let way = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    way.connect((camera, GVCP_PORT))?;
    let IpAddr::V4(own) = way.local_addr()?.ip() else {
        return Err(io::Error::other("the camera is not reached by IPv4"));
    };
    Ok((UdpSocket::bind((own, 0))?, own))
}

impl AravisCamera {
    /// Finds the largest packet that arrives, see [`crate::camera::Camera::test_packet_size`].
    pub(super) fn test_packets(&self, requested: u32) -> Result<Option<PacketTest>, CameraError> {
        let error = link_error(DOING);
        let from = Ipv4Addr::from_bits(checked::register(&self.device, OWN_ADDRESS).map_err(&error)?);
        let (socket, own) = socket_towards(from).map_err(|e| on_this_host(&e))?;
        let port = socket.local_addr().map_err(|e| on_this_host(&e))?.port();
        let others = checked::register(&self.device, PACKET_SIZE).map_err(&error)? & !(FIRE | SIZE);
        let tests = Tests { camera: self, socket, from: from.into(), others };
        tests.set(DESTINATION, own.to_bits())?;
        tests.set(HOST_PORT, u32::from(port))?;
        let found = packet_test::largest(requested, self.packet_sizes(), |size, patience| {
            tests.attempt(size, patience)
        });
        if let Ok(Some(found)) = found {
            tests.set(PACKET_SIZE, tests.others | found.arrived & SIZE)?;
        }
        self.close_stream_channel();
        match found? {
            Some(found) => Ok(Some(found)),
            // A camera without test packets does not have this feature.
            None if !self.has("GevSCPSFireTestPacket") => Ok(None),
            None => Err(CameraError::NoTestPackets { patience_ms: PATIENCE.as_millis() * TRIES as u128 }),
        }
    }

    /// The packet sizes that the description allows; any size where its limits contradict each other.
    fn packet_sizes(&self) -> Sizes {
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
    /// Writes a register; `false` where the camera refuses.
    fn set(&self, register: u64, value: u32) -> Result<bool, CameraError> {
        let written = self.camera.device.write_register(register, value);
        Ok(answered(written.map_err(|error| self.camera.not_set(&error)))?.is_some())
    }

    fn attempt(&self, requested: u32, patience: Duration) -> Result<Tried, CameraError> {
        let refused = Tried { size: None, arrived: None, took: Duration::ZERO };
        if !self.set(PACKET_SIZE, self.others | WHOLE | requested & SIZE)? {
            return Ok(refused);
        }
        let size = match checked::register(&self.camera.device, PACKET_SIZE) {
            Ok(value) => value & SIZE,
            Err(error) if is_silence(&error) => return Err(link_error(DOING)(error)),
            Err(_) => requested,
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

    /// The largest of the camera's packets that arrive until then; a packet of the requested size ends the wait.
    fn receive(&self, size: u32, until: Instant) -> io::Result<Option<u32>> {
        let mut largest = None;
        let last = receive_until(&self.socket, until, |packet, from| {
            if from != self.from {
                return None;
            }
            let bytes = u32::try_from(packet.len() + HEADERS).unwrap_or(LARGEST);
            largest = largest.max(Some(bytes));
            (bytes + packet_test::ROUNDED >= size).then_some(())
        });
        last.map(|_| largest)
    }
}
