// SPDX-License-Identifier: MIT OR Apache-2.0
//! Marks in the block that a whole transfer overwrites; they reveal a packet that arrived short.
//!
//! Aravis 0.8.26 takes a truncated packet for a whole one, and reports the frame as complete. Before a block is lent
//! to Aravis, the last [`MARK_BYTES`] of every packet's place get a mark that is random per stream. A mark that is
//! still there in a complete frame shows bytes that were never written. A packet that lacks fewer bytes than a mark
//! has overwrites a part of the mark; then the number of bytes that arrived reveals it.

use std::hash::{BuildHasher, RandomState};

/// Bytes of one mark. An image has them by chance once in 2^64 places.
pub const MARK_BYTES: usize = 8;

/// IP, UDP and GVSP headers of a payload packet with 16-bit and with 64-bit block ids (GigE Vision 2, "extended").
const HEADER_BYTES: [usize; 2] = [20 + 8 + 8, 20 + 8 + 20];

/// The marks of a stream's blocks. The stream makes them, plants them before a block is lent, and looks for survivors
/// when the frame is complete.
#[derive(Debug)]
pub struct Canaries {
    /// Twice the mark, so that each of its rotations is one slice.
    secret: [u8; 2 * MARK_BYTES],
    /// Positions of the marks' first bytes, ascending.
    places: Vec<usize>,
    /// Whether the last packet is shorter than the others, whatever the header.
    last_has_room: bool,
}

impl Canaries {
    /// Marks for images of `pixel_bytes` in IP packets of `packet_bytes`. Which of the two headers is in use is not
    /// known before the first frame: both give places, and a whole frame overwrites them all.
    pub fn new(pixel_bytes: usize, packet_bytes: usize) -> Self {
        let mark = RandomState::new().hash_one("mark").to_le_bytes();
        let mut secret = [0; 2 * MARK_BYTES];
        secret[..MARK_BYTES].copy_from_slice(&mark);
        secret[MARK_BYTES..].copy_from_slice(&mark);
        let payloads = HEADER_BYTES.map(|header| packet_bytes.saturating_sub(header));
        let ends = |payload: usize| {
            (1..).map_while(move |n| payload.checked_mul(n)).take_while(|&end| end < pixel_bytes)
        };
        let mut places: Vec<usize> = payloads
            .into_iter()
            .filter(|&payload| payload >= MARK_BYTES)
            .flat_map(ends)
            // The last packet is shorter: it ends with the frame.
            .chain([pixel_bytes])
            .filter_map(|end| end.checked_sub(MARK_BYTES))
            .collect();
        places.sort_unstable();
        places.dedup();
        let room = |payload: usize| payload > 0 && !pixel_bytes.is_multiple_of(payload);
        Self { secret, places, last_has_room: payloads.into_iter().all(room) }
    }

    /// Whether one byte beyond the image would arrive in the last packet. Then room for it reveals frames that are
    /// too long, without a change of the number of packets.
    pub fn last_has_room(&self) -> bool {
        self.last_has_room
    }

    /// The mark at `place`. Each byte depends on its place alone, so that marks may overlap.
    fn mark(&self, place: usize) -> &[u8] {
        let turn = place % MARK_BYTES;
        &self.secret[turn..turn + MARK_BYTES]
    }

    /// Writes the marks, before the block is lent.
    pub fn plant(&self, pixels: &mut [u8]) {
        for &place in &self.places {
            if let Some(bytes) = pixels.get_mut(place..place + MARK_BYTES) {
                bytes.copy_from_slice(self.mark(place));
            }
        }
    }

    /// The first place whose mark is still there: the end of a packet that arrived short, or not at all.
    pub fn survivor(&self, pixels: &[u8]) -> Option<usize> {
        let there = |place: &usize| pixels.get(*place..*place + MARK_BYTES) == Some(self.mark(*place));
        self.places.iter().copied().find(there)
    }
}

#[cfg(test)]
mod tests {
    use super::{Canaries, MARK_BYTES};
    use proptest::prelude::*;

    /// Writes packets as Aravis does; packet `short` lacks its last `missing` bytes.
    fn receive(pixels: &mut [u8], payload: usize, short: usize, missing: usize) {
        for (i, packet) in pixels.chunks_mut(payload).enumerate() {
            let lacks = if i == short { missing.min(packet.len()) } else { 0 };
            let arrived = packet.len() - lacks;
            packet[..arrived].fill(0x5a);
        }
    }

    proptest! {
        #[test]
        fn a_short_packet_is_found_and_a_whole_frame_is_not_suspected(
            pixel_bytes in 64usize..40_000,
            packet_bytes in 100usize..9001,
            header in prop::sample::select(vec![36usize, 48]),
            short: prop::sample::Index,
            missing in MARK_BYTES..9000,
        ) {
            let canaries = Canaries::new(pixel_bytes, packet_bytes);
            let payload = packet_bytes - header;
            let packets = pixel_bytes.div_ceil(payload);
            let mut pixels = vec![0; pixel_bytes];
            canaries.plant(&mut pixels);
            receive(&mut pixels, payload, packets, 0);
            prop_assert_eq!(canaries.survivor(&pixels), None);

            let short = short.index(packets);
            let length = if short + 1 == packets { pixel_bytes - short * payload } else { payload };
            // A last packet shorter than a mark shares it with the packet before.
            prop_assume!(length >= MARK_BYTES);
            canaries.plant(&mut pixels);
            receive(&mut pixels, payload, short, missing);
            let place = canaries.survivor(&pixels).expect("the short packet is found");
            prop_assert!(place / payload == short, "{} of packet {}", place, short);
        }
    }

    #[test]
    fn images_smaller_than_a_mark_and_packets_without_payload_do_no_harm() {
        for (pixel_bytes, packet_bytes) in [(0, 9000), (3, 9000), (100, 0), (100, 40)] {
            let canaries = Canaries::new(pixel_bytes, packet_bytes);
            let mut pixels = vec![0; pixel_bytes];
            canaries.plant(&mut pixels);
            pixels.fill(7);
            assert_eq!(canaries.survivor(&pixels), None);
        }
    }

    /// Prints the time that marks take per frame.
    #[test]
    #[ignore = "prints figures and judges none: cargo test --release --lib canary -- --ignored --nocapture"]
    fn cost_per_frame() {
        const BYTES: usize = 1920 * 1200;
        let canaries = Canaries::new(BYTES, 9000);
        // More than the caches hold, as in a session.
        let mut blocks: Vec<Vec<u8>> = (0..64).map(|_| vec![1; BYTES]).collect();
        let rounds = 10;
        let (mut plant, mut check) = (std::time::Duration::ZERO, std::time::Duration::ZERO);
        for _ in 0..rounds {
            let begin = std::time::Instant::now();
            blocks.iter_mut().for_each(|block| canaries.plant(block));
            plant += begin.elapsed();
            blocks.iter_mut().for_each(|block| block.fill(1));
            let begin = std::time::Instant::now();
            assert!(blocks.iter().all(|block| canaries.survivor(block).is_none()));
            check += begin.elapsed();
        }
        let per_frame = |total: std::time::Duration| total.as_nanos() / (rounds * blocks.len() as u128);
        println!(
            "{} marks of a frame of {BYTES} bytes: planted in {} ns, checked in {} ns",
            canaries.places.len(),
            per_frame(plant),
            per_frame(check)
        );
    }
}
