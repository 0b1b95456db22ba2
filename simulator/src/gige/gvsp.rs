// SPDX-License-Identifier: MIT OR Apache-2.0
//! GVSP, the GigE Vision stream protocol: the bytes of leader, payload and trailer packets, nothing else.
//!
//! A block (one image) is the leader (packet id 0), `n` payload packets (1..=n), all full but the last, and
//! the trailer (n + 1). Headers have 8 bytes with 16-bit block ids, which skip 0 when they wrap, or 20
//! bytes with 64-bit block ids ("extended id mode").

use serde::Deserialize;

/// Pixel format code of 8-bit grey (GenICam PFNC).
pub const MONO8: u32 = 0x0108_0001;
/// Names and codes (PFNC) of the pixel formats that the cameras have.
pub const FORMATS: [(&str, u32); 11] = [
    ("Mono8", MONO8),
    ("Mono10", 0x0110_0003),
    ("Mono10p", 0x010a_0046),
    ("Mono10Packed", 0x010c_0004),
    ("Mono12", 0x0110_0005),
    ("Mono12p", 0x010c_0047),
    ("Mono12Packed", 0x010c_0006),
    ("Mono14", 0x0110_0025),
    ("Mono16", 0x0110_0007),
    ("BayerRG8", 0x0108_0009),
    ("RGB8", 0x0218_0014),
];
/// Bytes of IP and UDP headers, which the packet size register counts in.
pub const IP_UDP_OVERHEAD: usize = 28;
/// Bytes of the longest header of a GVSP packet.
pub const MAX_HEADER: usize = 20;
/// Bytes of an image leader after the GVSP header.
pub const LEADER_BODY: usize = 36;
/// Bytes of an image trailer after the GVSP header.
pub const TRAILER_BODY: usize = 8;

const LEADER: u8 = 1;
const TRAILER: u8 = 2;
const PAYLOAD: u8 = 3;
const EXTENDED: u8 = 0x80;
/// Payload type of chunks whose leader states only the time.
const CHUNK_DATA: u16 = 4;
/// Bytes of its leader after the GVSP header.
const SHORT_LEADER_BODY: usize = 12;
/// Bytes of a chunk's id and length.
const CHUNK_TAIL: usize = 8;
const FLAG_RESEND: u16 = 0x0001;

/// The status field of a GVSP packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u16)]
pub enum Status {
    /// Sent for the first time.
    Ok = 0x0000,
    Resent = 0x0100,
    /// Cannot be sent again: not in the camera's memory.
    Unavailable = 0x800c,
}

/// Width of the ids in every header of a stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum IdMode {
    /// 16-bit block ids (1..=65535, 0 is skipped), 24-bit packet ids, 8-byte headers.
    Standard,
    /// 64-bit block ids, 32-bit packet ids, 20-byte headers.
    Extended,
}

impl IdMode {
    /// Bytes of a GVSP header.
    pub fn header_size(self) -> usize {
        match self {
            IdMode::Standard => 8,
            IdMode::Extended => MAX_HEADER,
        }
    }

    /// The block id after `id`; the first one is 1.
    pub fn next_block_id(self, id: u64) -> u64 {
        match self {
            IdMode::Standard if id >= 0xffff => 1,
            IdMode::Standard | IdMode::Extended => id.wrapping_add(1).max(1),
        }
    }
}

/// The payload type that a leader states.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u16)]
pub enum Payload {
    #[default]
    Image = 1,
    /// An image that chunks follow.
    ImageWithChunks = 0x4001,
    /// The same, as the standard had it before.
    ExtendedChunks = 5,
    /// Chunks, the first of which is an image.
    ChunkData = CHUNK_DATA,
}

impl Payload {
    /// Whether chunks follow the image.
    pub fn has_chunks(self) -> bool {
        self != Self::Image
    }
}

/// What the payload of an image is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Form {
    /// PFNC code of its pixels.
    pub format: u32,
    /// The pixel format that the leader states.
    pub told: u32,
    /// Padding bytes that follow each row.
    pub padding: u16,
    /// Bytes that follow the image in its payload.
    pub appended: u32,
    /// The payload type that the leader states.
    pub payload: Payload,
    /// Bytes by which every full packet is shorter than requested.
    pub short: u16,
}

impl Default for Form {
    fn default() -> Self {
        Self { format: MONO8, told: MONO8, padding: 0, appended: 0, payload: Payload::Image, short: 0 }
    }
}

impl Form {
    /// Bytes of a row, without its padding: a PFNC code has the number of bits of a pixel.
    pub fn line(&self, width: u32) -> usize {
        (width as usize * (self.format >> 16 & 0xff) as usize).div_ceil(8)
    }

    /// Bytes of a whole payload.
    pub fn payload(&self, width: u32, height: u32) -> usize {
        (self.line(width) + usize::from(self.padding)) * height as usize + self.appended as usize
    }

    /// Byte number `at` behind an image of `image` bytes. Where chunks were announced and fit, they are the image's
    /// tail and one chunk that has the rest of the room; else, and in what that chunk holds, it is something that is
    /// not 0.
    pub fn behind(&self, at: usize, image: usize) -> u8 {
        const FILL: u8 = 0xa5;
        let room = self.appended as usize;
        let tail = |id: u32, length: usize, at: usize| {
            let length = u32::try_from(length).unwrap_or(u32::MAX);
            [id.to_be_bytes(), length.to_be_bytes()].concat()[at]
        };
        let fits = room == CHUNK_TAIL || room >= 2 * CHUNK_TAIL;
        match at.checked_sub(room - CHUNK_TAIL.min(room)) {
            _ if !self.payload.has_chunks() || !fits => FILL,
            _ if at < CHUNK_TAIL => tail(1, image, at),
            Some(at) => tail(2, room - 2 * CHUNK_TAIL, at),
            None => FILL,
        }
    }

    /// Whether a payload is the image's pixels and nothing else.
    pub fn is_plain(&self) -> bool {
        self.format == MONO8 && self.padding == 0 && self.appended == 0
    }
}

/// How one image is cut into packets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Layout {
    pub width: u32,
    pub height: u32,
    /// Whether block ids have 16 or 64 bits.
    pub ids: IdMode,
    /// Payload bytes of every full payload packet.
    pub chunk: usize,
    pub form: Form,
}

impl Layout {
    /// Cuts a Mono8 image for a packet size that counts IP, UDP and GVSP headers in (register SCPS).
    /// `None` where a packet would hold no pixel.
    pub fn new(width: u32, height: u32, packet_size: u16, ids: IdMode) -> Option<Self> {
        let chunk = usize::from(packet_size).checked_sub(IP_UDP_OVERHEAD + ids.header_size())?;
        if chunk == 0 || width == 0 || height == 0 {
            return None;
        }
        Some(Self { width, height, ids, chunk, form: Form::default() })
    }

    /// The same for a payload of this form.
    #[must_use]
    pub fn with(self, form: Form) -> Self {
        let asked = self.chunk + usize::from(self.form.short);
        Self { chunk: asked.saturating_sub(usize::from(form.short)).max(1), form, ..self }
    }

    /// Bytes of the payload with all padding.
    pub fn image_bytes(&self) -> usize {
        self.form.payload(self.width, self.height)
    }

    /// Number of payload packets; the trailer's packet id is one more.
    pub fn payload_packets(&self) -> u32 {
        u32::try_from(self.image_bytes().div_ceil(self.chunk)).unwrap_or(u32::MAX)
    }

    /// The packet id of a block's trailer.
    pub fn trailer_id(&self) -> u32 {
        self.payload_packets().saturating_add(1)
    }

    /// Image bytes of a payload packet, empty for ids that are none.
    pub fn range(&self, packet_id: u32) -> std::ops::Range<usize> {
        if packet_id == 0 || packet_id > self.payload_packets() {
            return 0..0;
        }
        let start = (packet_id as usize - 1) * self.chunk;
        start..(start + self.chunk).min(self.image_bytes())
    }
}

/// A GVSP header in the first [`IdMode::header_size`] bytes of the array.
fn header(ids: IdMode, status: Status, format: u8, block_id: u64, packet_id: u32) -> [u8; MAX_HEADER] {
    let mut bytes = [0; MAX_HEADER];
    bytes[..2].copy_from_slice(&(status as u16).to_be_bytes());
    match ids {
        IdMode::Standard => {
            bytes[2..4].copy_from_slice(&((block_id & 0xffff) as u16).to_be_bytes());
            bytes[4..8].copy_from_slice(&(u32::from(format) << 24 | packet_id & 0x00ff_ffff).to_be_bytes());
        }
        IdMode::Extended => {
            let flags = if status == Status::Resent { FLAG_RESEND } else { 0 };
            bytes[2..4].copy_from_slice(&flags.to_be_bytes());
            bytes[4] = format | EXTENDED;
            bytes[8..16].copy_from_slice(&block_id.to_be_bytes());
            bytes[16..20].copy_from_slice(&packet_id.to_be_bytes());
        }
    }
    bytes
}

/// The headers of all payload packets of an image, built once and stamped with each new block id.
#[derive(Debug)]
pub struct PayloadHeaders {
    ids: IdMode,
    bytes: Vec<u8>,
}

impl PayloadHeaders {
    /// Headers for packets 1..=n of this layout.
    pub fn new(layout: &Layout) -> Self {
        let size = layout.ids.header_size();
        let mut bytes = Vec::with_capacity(size * layout.payload_packets() as usize);
        for id in 1..=layout.payload_packets() {
            bytes.extend_from_slice(&header(layout.ids, Status::Ok, PAYLOAD, 0, id)[..size]);
        }
        Self { ids: layout.ids, bytes }
    }

    /// Writes the block id into every header.
    pub fn stamp(&mut self, block_id: u64) {
        let short = ((block_id & 0xffff) as u16).to_be_bytes();
        let long = block_id.to_be_bytes();
        for header in self.bytes.chunks_exact_mut(self.ids.header_size()) {
            match self.ids {
                IdMode::Standard => header[2..4].copy_from_slice(&short),
                IdMode::Extended => header[8..16].copy_from_slice(&long),
            }
        }
    }

    /// The header of payload packet `packet_id` (1..=n); empty for others.
    pub fn get(&self, packet_id: u32) -> &[u8] {
        let size = self.ids.header_size();
        let start = (packet_id as usize).saturating_sub(1) * size;
        if packet_id == 0 { &[] } else { self.bytes.get(start..start + size).unwrap_or(&[]) }
    }
}

/// The leader packet: when the exposure began (camera clock ticks) and the image's geometry.
pub fn leader(layout: &Layout, status: Status, block_id: u64, timestamp: u64) -> Vec<u8> {
    let size = layout.ids.header_size();
    let mut bytes = Vec::with_capacity(size + LEADER_BODY);
    bytes.extend_from_slice(&header(layout.ids, status, LEADER, block_id, 0)[..size]);
    bytes.extend([0, 0]);
    bytes.extend((layout.form.payload as u16).to_be_bytes());
    bytes.extend(timestamp.to_be_bytes());
    bytes.extend(layout.form.told.to_be_bytes());
    bytes.extend(layout.width.to_be_bytes());
    bytes.extend(layout.height.to_be_bytes());
    bytes.extend([0; 8]); // offset x, offset y
    bytes.extend(layout.form.padding.to_be_bytes());
    bytes.extend([0; 2]); // padding y
    if layout.form.payload == Payload::ChunkData {
        bytes.truncate(size + SHORT_LEADER_BODY);
    }
    bytes
}

/// The trailer packet: the number of rows that were sent.
pub fn trailer(layout: &Layout, status: Status, block_id: u64) -> Vec<u8> {
    let size = layout.ids.header_size();
    let mut bytes = Vec::with_capacity(size + TRAILER_BODY);
    bytes.extend_from_slice(&header(layout.ids, status, TRAILER, block_id, layout.trailer_id())[..size]);
    bytes.extend([0, 0]);
    bytes.extend((layout.form.payload as u16).to_be_bytes());
    bytes.extend(layout.height.to_be_bytes());
    bytes
}

/// A payload packet sent again.
pub fn resent_payload(layout: &Layout, block_id: u64, packet_id: u32, pixels: &[u8]) -> Vec<u8> {
    let size = layout.ids.header_size();
    let mut bytes = header(layout.ids, Status::Resent, PAYLOAD, block_id, packet_id)[..size].to_vec();
    bytes.extend_from_slice(pixels);
    bytes
}

/// The answer to a resend request that cannot be fulfilled: a header with that status.
pub fn unavailable(ids: IdMode, block_id: u64, packet_id: u32) -> Vec<u8> {
    header(ids, Status::Unavailable, PAYLOAD, block_id, packet_id)[..ids.header_size()].to_vec()
}

/// A test packet: as long as the packet size register asks for, block id 0, zeros.
pub fn test_packet(packet_size: u16) -> Vec<u8> {
    let length = usize::from(packet_size).saturating_sub(IP_UDP_OVERHEAD);
    let mut bytes = vec![0; length];
    for (to, from) in bytes.iter_mut().zip(header(IdMode::Standard, Status::Ok, PAYLOAD, 0, 0)) {
        *to = from;
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn layout(ids: IdMode) -> Layout {
        Layout::new(0x0780, 0x04b0, 9000, ids).expect("a valid layout")
    }

    #[test]
    fn leader_has_the_bytes_of_the_standard() {
        let bytes = leader(&layout(IdMode::Standard), Status::Ok, 0x1234, 0x0102_0304_0506_0708);
        let golden = [
            0x00, 0x00, 0x12, 0x34, // status ok, block id
            0x01, 0x00, 0x00, 0x00, // leader, packet id 0
            0x00, 0x00, 0x00, 0x01, // reserved, payload type image
            0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, // timestamp
            0x01, 0x08, 0x00, 0x01, // Mono8
            0x00, 0x00, 0x07, 0x80, // 1920 columns
            0x00, 0x00, 0x04, 0xb0, // 1200 rows
            0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, // offsets, paddings
        ];
        assert_eq!(bytes, golden);
    }

    #[test]
    fn extended_headers_have_the_bytes_of_the_standard() {
        let bytes = trailer(&layout(IdMode::Extended), Status::Resent, 0x0000_0001_0000_0002);
        let golden = [
            0x01, 0x00, 0x00, 0x01, // status resent, flag packet resend
            0x82, 0x00, 0x00, 0x00, // extended ids, trailer
            0x00, 0x00, 0x00, 0x01, 0x00, 0x00, 0x00, 0x02, // block id
            0x00, 0x00, 0x01, 0x03, // packet id 259: 258 payload packets of 8952 bytes
            0x00, 0x00, 0x00, 0x01, // reserved, payload type image
            0x00, 0x00, 0x04, 0xb0, // rows
        ];
        assert_eq!(bytes, golden);
    }

    #[test]
    fn payload_headers_carry_block_and_packet_id() {
        let mut headers = PayloadHeaders::new(&layout(IdMode::Standard));
        headers.stamp(0xabcd);
        // status ok, block id | payload format 3, packet id 257
        assert_eq!(headers.get(257), [0x00, 0x00, 0xab, 0xcd, 0x03, 0x00, 0x01, 0x01]);
        assert!(headers.get(0).is_empty() && headers.get(260).is_empty());
    }

    /// Chunks are found from the end of a payload: each ends with its id and its length.
    #[test]
    fn what_is_appended_is_chunks_where_they_were_announced() {
        let bytes = |payload, appended: u32| -> Vec<u8> {
            let form = Form { payload, appended, ..Form::default() };
            (0..appended as usize).map(|at| form.behind(at, 0x1234)).collect()
        };
        let image = [0, 0, 0, 1, 0, 0, 0x12, 0x34];
        assert_eq!(bytes(Payload::ImageWithChunks, 8), image);
        let second = [0xa5, 0xa5, 0, 0, 0, 2, 0, 0, 0, 2];
        assert_eq!(bytes(Payload::ChunkData, 18), [&image[..], &second].concat());
        assert_eq!(bytes(Payload::Image, 8), [0xa5; 8]);
        assert_eq!(bytes(Payload::ExtendedChunks, 12), [0xa5; 12]);
        assert!(bytes(Payload::ChunkData, 0).is_empty());
    }

    #[test]
    fn standard_block_ids_skip_zero() {
        assert_eq!(IdMode::Standard.next_block_id(0xffff), 1);
        assert_eq!(IdMode::Extended.next_block_id(0xffff), 0x1_0000);
        assert_eq!(IdMode::Extended.next_block_id(u64::MAX), 1);
    }

    proptest! {
        #[test]
        fn payload_packets_tile_the_image(
            width in 1u32..3000, height in 1u32..2000, packet_size in 49u16..=65532, extended: bool,
        ) {
            let ids = if extended { IdMode::Extended } else { IdMode::Standard };
            let layout = Layout::new(width, height, packet_size, ids).expect("room for pixels");
            prop_assume!(layout.payload_packets() < 5000);
            let mut next = 0;
            for id in 1..=layout.payload_packets() {
                let range = layout.range(id);
                prop_assert_eq!(range.start, next);
                let last = id == layout.payload_packets();
                prop_assert!(last || range.len() == layout.chunk, "all packets but the last are full");
                next = range.end;
            }
            prop_assert_eq!(next, layout.image_bytes());
            prop_assert!(layout.range(0).is_empty() && layout.range(layout.trailer_id()).is_empty());
        }
    }
}
