// SPDX-License-Identifier: MIT OR Apache-2.0
//! The load of a node on its host: bytes, packets and memory.

use crate::config::{NodeConfig, SocketMode};
use crate::host::frame_memory::ROOM_BYTES;
use crate::network::wire;

/// The load of one node, by which its host is judged.
#[derive(Debug, Clone, PartialEq)]
pub struct Load {
    /// Bytes of one recorded frame of each camera.
    pub frames: Vec<u64>,
    pub rate_hz: f64,
    /// Bytes of a GVSP packet, IP header included.
    pub packet_bytes: u32,
    pub buffers_per_camera: usize,
    pub socket: SocketMode,
}

impl Load {
    /// Four cameras of 1920 x 1200 at 120 Hz in jumbo frames: what a host is judged by without a
    /// configuration.
    pub fn reference() -> Self {
        Self {
            frames: vec![1920 * 1200; 4],
            rate_hz: 120.0,
            packet_bytes: 9000,
            buffers_per_camera: 64,
            socket: SocketMode::Auto,
        }
    }

    /// The load of a node, by its rig and its node file.
    pub fn of(config: &NodeConfig) -> Self {
        let cameras = config.rig.cameras_of(&config.node);
        Self {
            frames: cameras.map(|(_, c)| (c.device.width * c.device.height) as u64).collect(),
            rate_hz: config.rig.trigger_rate_hz,
            packet_bytes: config.packet_bytes,
            buffers_per_camera: config.buffers_per_camera,
            socket: config.socket,
        }
    }

    /// Pixels of all cameras together, bytes per second.
    pub fn bytes_per_s(&self) -> f64 {
        self.frames.iter().sum::<u64>() as f64 * self.rate_hz
    }

    /// Bytes of the largest frame of all cameras.
    pub fn largest_frame(&self) -> u64 {
        self.frames.iter().copied().max().unwrap_or(0)
    }

    /// Packets of one frame, with leader and trailer.
    pub fn packets(&self, frame_bytes: u64) -> u64 {
        wire::packets(frame_bytes, self.packet_bytes)
    }

    /// Packets that arrive together after one trigger.
    pub fn packets_per_trigger(&self) -> u64 {
        self.frames.iter().map(|&frame| self.packets(frame)).sum()
    }

    /// What one camera's link carries, bits per second, headers included.
    pub fn link_bits_per_s(&self, frame_bytes: u64) -> f64 {
        wire::bytes(frame_bytes, self.packet_bytes) as f64 * 8.0 * self.rate_hz
    }

    /// Bytes of memory that the frame pools of all cameras take.
    pub fn pool_bytes(&self) -> u64 {
        let blocks = self.frames.iter().map(|frame| frame + ROOM_BYTES as u64);
        blocks.sum::<u64>() * self.buffers_per_camera as u64
    }

    /// Half the time between two triggers, ns: a clock that takes longer to read cannot tell triggers apart.
    pub fn half_period_ns(&self) -> u64 {
        (0.5e9 / self.rate_hz) as u64
    }

    /// How long the frame pools hold what arrives while the disk stands still, seconds.
    pub fn buffered_s(&self) -> f64 {
        self.buffers_per_camera as f64 / self.rate_hz
    }
}

#[cfg(test)]
mod tests {
    use super::Load;

    #[test]
    fn the_reference_is_four_cameras_of_2_3_megapixels_at_120_hz() {
        let load = Load::reference();
        assert!((load.bytes_per_s() / 1.106e9 - 1.0).abs() < 1e-3);
        // 258 payload packets, leader and trailer.
        assert_eq!((load.packets(load.largest_frame()), load.packets_per_trigger()), (260, 1040));
        assert!((load.link_bits_per_s(1920 * 1200) / 2.23e9 - 1.0).abs() < 1e-2);
        assert_eq!(load.pool_bytes(), 4 * 64 * (1920 * 1200 + 4096));
    }
}
