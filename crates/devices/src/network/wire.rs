// SPDX-License-Identifier: MIT OR Apache-2.0
//! The load of a frame on a link: its packets, and the bytes around them.

/// Bytes of the IP, UDP and GVSP headers of a payload packet with 16-bit block ids; they are part of the packet's size.
pub const HEADERS: u64 = 36;
/// Bytes of Ethernet's preamble, header, checksum and gap around each packet.
pub const ETHERNET: u64 = 38;

/// Number of packets of a frame, with leader and trailer. `packet_bytes`: size of the IP packet.
pub fn packets(frame_bytes: u64, packet_bytes: u32) -> u64 {
    frame_bytes.div_ceil(u64::from(packet_bytes).saturating_sub(HEADERS).max(1)) + 2
}

/// Bytes of a frame on an Ethernet link, with everything around its packets.
pub fn bytes(frame_bytes: u64, packet_bytes: u32) -> u64 {
    frame_bytes + packets(frame_bytes, packet_bytes) * (HEADERS + ETHERNET)
}
