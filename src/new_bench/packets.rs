// SPDX-License-Identifier: MIT OR Apache-2.0
//! The largest packet that camera and host take, and the time between two packets that a shared link needs.

use crate::camera::{Camera, CameraError};
use crate::config::PacketDelay;
use crate::network::wire;

/// The largest packet to try, bytes: larger ones are no standard, and save little.
const LARGEST: u32 = 9000;
/// Bytes of a packet that every camera can send and every network carries.
const LEAST: u32 = 1500;

/// The largest packet that arrives, at most the interface's MTU; `None` where the transport has no packets.
///
/// # Errors
/// None arrives, or the camera is lost.
pub fn largest(camera: &mut dyn Camera, mtu: Option<u32>) -> Result<Option<u32>, CameraError> {
    let most = mtu.unwrap_or(LEAST).min(LARGEST);
    Ok(camera.test_packet_size(most)?.map(|test| test.arrived))
}

/// The packets on one link after a trigger.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Burst {
    /// Cameras that send at once.
    pub cameras: usize,
    /// Bytes of one frame of a camera.
    pub frame_bytes: usize,
    /// Bytes of a packet, with all its headers but those of Ethernet.
    pub packet_bytes: u32,
    /// From trigger to trigger, ns.
    pub period_ns: u64,
}

impl Burst {
    /// Bits a second on the link.
    pub fn bits_per_s(&self) -> f64 {
        let bytes = wire::bytes(self.frame_bytes as u64, self.packet_bytes) * self.cameras as u64;
        bytes as f64 * 8.0 * 1e9 / self.period_ns as f64
    }

    /// The time between two packets of a camera: those of the others fit in between, and a frame still fits into nine
    /// tenths of a period. Without the link's rate it is the cameras' own share of the period.
    pub fn delay(&self, speed_mbit: Option<u64>) -> Option<PacketDelay> {
        if self.cameras < 2 {
            return None;
        }
        let Some(speed) = speed_mbit.filter(|speed| *speed > 0) else { return Some(PacketDelay::Auto) };
        let packet_us = (u64::from(self.packet_bytes) + wire::ETHERNET) as f64 * 8.0 / speed as f64;
        let wanted = packet_us * (self.cameras - 1) as f64;
        let packets = wire::packets(self.frame_bytes as u64, self.packet_bytes) as f64;
        let room = 0.9 * self.period_ns as f64 / 1000.0 / packets - packet_us;
        Some(PacketDelay::Microseconds((wanted.min(room.max(0.0)) * 10.0).floor() / 10.0))
    }
}

#[cfg(test)]
mod tests {
    use super::Burst;
    use crate::config::PacketDelay;

    #[test]
    fn packets_of_others_fit_in_between_and_the_frame_into_its_period() {
        let alone = Burst { cameras: 1, frame_bytes: 1920 * 1200, packet_bytes: 9000, period_ns: 8_333_333 };
        assert_eq!(alone.delay(Some(10_000)), None);
        let four = Burst { cameras: 4, ..alone };
        // A packet takes 7.23 us at 10 Gbit/s; 261 of them in 7.5 ms leave 28.8 us each.
        assert_eq!(four.delay(Some(10_000)), Some(PacketDelay::Microseconds(21.6)));
        assert_eq!(four.delay(None), Some(PacketDelay::Auto));
        assert!((four.bits_per_s() / 8.93e9 - 1.0).abs() < 0.01, "{}", four.bits_per_s());
        // Too slow a link: as much as there is room for.
        assert_eq!(four.delay(Some(2_000)), Some(PacketDelay::Microseconds(0.0)));
        assert!(four.bits_per_s() > 2e9);
    }
}
