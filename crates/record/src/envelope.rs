// SPDX-License-Identifier: MIT OR Apache-2.0
//! A frame as a message: `foxglove.RawImage` with identity and checksums, pixels last.
//!
//! `RawImage` as Foxglove publishes it has timestamp = 1, width = 2, height = 3, encoding = 4, step = 5,
//! data = 6, frame_id = 7. Fields from 1001 on are ours; the embedded descriptor declares them.

use super::belonging::SessionMark;
use super::layout::MAX_CAMERA_NAME;
use super::protobuf::{self, Fixed, Kind, MessageReader, MessageWriter, Value, written};
use crate::base::ids::{BlockId, CameraId, TriggerIndex};
use std::io::Write;
use std::ops::Range;

/// Room that a frame's buffer needs in front of the pixels, bytes.
pub const ENVELOPE_CAPACITY: usize = 256;

/// Name of the message's schema.
pub const SCHEMA_NAME: &str = "foxglove.RawImage";

const ENCODING: &[u8] = b"mono8";
const PIXELS: u64 = 6;
const TRIGGER: u32 = 1001;
const BLOCK: u32 = 1002;
const CAMERA_TIME: u32 = 1003;
const HOST_TIME: u32 = 1004;
const PIXELS_CRC: u32 = 1005;
const ENVELOPE_CRC: u32 = 1006;
const PADDING: u32 = 1007;
const SESSION: u32 = 1008;

/// Bytes of the padding field without its content: two of tag, two of length (a varint that is not shortened,
/// so that the field can have any length from here on).
const PADDING_OVERHEAD: usize = 4;
/// The longest padded envelope: one page.
const PADDED_MAX: usize = 4096;
/// No frame's message has more bytes in front of its pixels, fields of later versions included.
pub(super) const FRONT: usize = 2 * PADDED_MAX;

/// Identity of a frame and the checksum of its pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameMeta {
    /// The trigger, proven by block id and camera timestamp.
    pub trigger: TriggerIndex,
    /// Block id as the camera sent it.
    pub block: BlockId,
    /// When the exposure began, camera clock, ns.
    pub camera_time_ns: u64,
    /// When the frame arrived, host clock, ns.
    pub host_time_ns: u64,
    pub width: u32,
    pub height: u32,
    /// CRC-32 (IEEE) of the pixels; see [`pixels_crc`].
    pub pixels_crc: u32,
}

/// CRC-32 (IEEE) of a frame's pixels.
pub fn pixels_crc(pixels: &[u8]) -> u32 {
    crc32fast::hash(pixels)
}

/// A frame's message, parsed: identity, and where its pixels are.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Envelope<'a> {
    pub camera: &'a str,
    pub meta: FrameMeta,
    /// Mark of its session; messages of version 1 have none.
    pub session: Option<SessionMark>,
    /// Where the pixels are in the message; they reach to its end.
    pub pixels: Range<usize>,
}

/// Why a message is not a frame.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum EnvelopeError {
    /// The bytes are no protobuf message, or are cut.
    #[error("frame message is not valid protobuf at byte {offset}")]
    Malformed { offset: usize },
    /// A field is absent, repeated with another type, or has a value that a frame cannot have.
    #[error("frame message: {field} is {found}, expected {expected}")]
    Field { field: &'static str, found: String, expected: String },
    /// The bytes before the pixels are not those that were written.
    #[error("envelope checksum is {found:#010x}, but the message states {stated:#010x}: it is damaged")]
    Checksum { found: u32, stated: u32 },
    /// The room in front of the pixels does not suffice.
    #[error("the envelope needs {needed} bytes in front of the pixels, {room} are there")]
    Room { needed: usize, room: usize },
}

/// Writes the envelope to the end of `room`, so that the pixels that follow in the same buffer continue it,
/// and returns its length: the message is that many last bytes of `room`, and the pixels.
///
/// `room` of [`ENVELOPE_CAPACITY`] bytes always suffices. The recording that takes the message marks it with its
/// session.
pub fn write_envelope(room: &mut [u8], camera: &CameraId, meta: &FrameMeta) -> Result<usize, EnvelopeError> {
    let envelope = encode(None, camera, meta)?;
    let envelope = written(&envelope);
    let start = room
        .len()
        .checked_sub(envelope.len())
        .ok_or(EnvelopeError::Room { needed: envelope.len(), room: room.len() })?;
    room[start..].copy_from_slice(envelope);
    Ok(envelope.len())
}

/// A message as it is, but marked with a session.
pub(super) fn marked(session: SessionMark, message: &[u8]) -> Result<Vec<u8>, EnvelopeError> {
    let envelope = parse_envelope(message)?;
    let front = encode(Some(session), &CameraId::from(envelope.camera), &envelope.meta)?;
    Ok([written(&front), &message[envelope.pixels]].concat())
}

/// As [`write_envelope`], but the envelope becomes exactly `length` bytes long, by a field of zeros that every
/// reader skips: so the pixels begin where the disk requires it. [`padded_lengths`] gives the possible lengths.
pub(super) fn write_padded_envelope(
    room: &mut [u8],
    session: Option<SessionMark>,
    camera: &CameraId,
    meta: &FrameMeta,
    length: usize,
) -> Result<(), EnvelopeError> {
    let fields = encode_fields(session, camera, meta)?;
    let fields = written(&fields);
    let bare = fields.len() + written(&encode_end(meta, 0)).len();
    let padding = length.checked_sub(bare + PADDING_OVERHEAD).filter(|_| length <= room.len());
    let padding = padding.ok_or(EnvelopeError::Room { needed: length, room: room.len() })?;
    let start = room.len() - length;
    let (front, rest) = room[start..].split_at_mut(fields.len());
    front.copy_from_slice(fields);
    let (field, end) = rest.split_at_mut(PADDING_OVERHEAD + padding);
    let tag = PADDING << 3 | 2;
    field.fill(0);
    field[0] = tag as u8 | 0x80;
    field[1] = (tag >> 7) as u8;
    field[2] = padding as u8 | 0x80;
    field[3] = (padding >> 7) as u8;
    let mut crc = crc32fast::Hasher::new();
    crc.update(front);
    crc.update(field);
    end.copy_from_slice(written(&encode_end(meta, crc.finalize())));
    Ok(())
}

/// The lengths that [`write_padded_envelope`] can give to this envelope.
pub(super) fn padded_lengths(
    session: Option<SessionMark>,
    camera: &CameraId,
    meta: &FrameMeta,
) -> Result<std::ops::RangeInclusive<usize>, EnvelopeError> {
    let bare = written(&encode(session, camera, meta)?).len();
    Ok(bare + PADDING_OVERHEAD..=PADDED_MAX)
}

fn encode(
    session: Option<SessionMark>,
    camera: &CameraId,
    meta: &FrameMeta,
) -> Result<Fixed<ENVELOPE_CAPACITY>, EnvelopeError> {
    let mut envelope = encode_fields(session, camera, meta)?;
    let crc = crc32fast::hash(written(&envelope));
    // The longest envelope fits, see `encode_fields`.
    let _ = envelope.write_all(written(&encode_end(meta, crc)));
    Ok(envelope)
}

/// What stands between the checked fields and the pixels.
fn encode_end(meta: &FrameMeta, crc: u32) -> Fixed<24> {
    let pixels = u64::from(meta.width) * u64::from(meta.height);
    MessageWriter::fixed().fixed32(ENVELOPE_CRC, crc).bytes_header(6, pixels).into_bytes()
}

/// No allocation, because it runs for every frame. With the longest name the envelope has 211 bytes.
fn encode_fields(
    session: Option<SessionMark>,
    camera: &CameraId,
    meta: &FrameMeta,
) -> Result<Fixed<ENVELOPE_CAPACITY>, EnvelopeError> {
    let name = camera.as_str().as_bytes();
    if name.len() > MAX_CAMERA_NAME {
        return Err(field_error(
            "frame_id",
            format!("{} bytes", name.len()),
            format!("at most {MAX_CAMERA_NAME}"),
        ));
    }
    let timestamp: Fixed<24> = protobuf::timestamp(MessageWriter::fixed(), meta.host_time_ns).into_bytes();
    let checked = MessageWriter::<Fixed<ENVELOPE_CAPACITY>>::fixed()
        .bytes(1, written(&timestamp))
        .fixed32(2, meta.width)
        .fixed32(3, meta.height)
        .bytes(4, ENCODING)
        .fixed32(5, meta.width)
        .bytes(7, name)
        .fixed64(TRIGGER, meta.trigger.0)
        .fixed64(BLOCK, meta.block.0)
        .fixed64(CAMERA_TIME, meta.camera_time_ns)
        .fixed64(HOST_TIME, meta.host_time_ns)
        .fixed32(PIXELS_CRC, meta.pixels_crc);
    let checked = match session {
        Some(session) => checked.fixed64(SESSION, session.0),
        None => checked,
    };
    Ok(checked.into_bytes())
}

fn field_error(field: &'static str, found: impl Into<String>, expected: impl Into<String>) -> EnvelopeError {
    EnvelopeError::Field { field, found: found.into(), expected: expected.into() }
}

#[derive(Default)]
struct Fields<'a> {
    width: Option<u32>,
    height: Option<u32>,
    step: Option<u32>,
    encoding: Option<&'a [u8]>,
    camera: Option<&'a [u8]>,
    trigger: Option<u64>,
    block: Option<u64>,
    camera_time: Option<u64>,
    host_time: Option<u64>,
    pixels_crc: Option<u32>,
    session: Option<u64>,
    /// As stated, and the length of what it covers.
    envelope_crc: Option<(u32, usize)>,
}

/// Finds identity, checksum and pixels in a frame's message, and checks the envelope's own checksum. The
/// pixels' checksum is left to the caller, because it costs a pass over all of them.
pub fn parse_envelope(message: &[u8]) -> Result<Envelope<'_>, EnvelopeError> {
    let (envelope, length) = parse_envelope_of(message)?;
    if length > message.len() {
        return Err(EnvelopeError::Malformed { offset: envelope.pixels.start });
    }
    if length < message.len() {
        let extra = message.len() - length;
        return Err(field_error("data", format!("followed by {extra} bytes"), "the last field"));
    }
    Ok(envelope)
}

/// Whether bytes begin as every frame's message does: with the time stamp (field 1), then the width (field 2).
pub(super) fn begins_like_envelope(bytes: &[u8]) -> bool {
    const TIMESTAMP: u8 = 1 << 3 | 2;
    const WIDTH: u8 = 2 << 3 | 5;
    let [TIMESTAMP, length, rest @ ..] = bytes else { return false };
    // Two varints with their tags.
    *length <= 22 && rest.get(usize::from(*length)) == Some(&WIDTH)
}

/// As [`parse_envelope`], of bytes that a frame's message begins, which need not reach into the pixels; returns the
/// message's length as well.
pub(super) fn parse_envelope_of(message: &[u8]) -> Result<(Envelope<'_>, usize), EnvelopeError> {
    let mut reader = MessageReader::new(message);
    let mut fields = Fields::default();
    let (first, length) = loop {
        let start = reader.position();
        let malformed = EnvelopeError::Malformed { offset: start };
        if let Some(length) = reader.enter_bytes(PIXELS) {
            break (reader.position(), length);
        }
        match reader.next_field().map_err(|()| malformed)? {
            None => return Err(field_error("data", "absent", "the last field")),
            Some((number, value)) => note(&mut fields, number, value, start),
        }
    };
    let end = usize::try_from(length).ok().and_then(|length| first.checked_add(length));
    let end = end.ok_or(EnvelopeError::Malformed { offset: first })?;
    finish(&fields, message, first..end).map(|envelope| (envelope, end))
}

fn note<'a>(fields: &mut Fields<'a>, number: u64, value: Value<'a>, start: usize) {
    match (u32::try_from(number).unwrap_or(0), value) {
        (2, Value::Fixed32(v)) => fields.width = Some(v),
        (3, Value::Fixed32(v)) => fields.height = Some(v),
        (4, Value::Bytes(v)) => fields.encoding = Some(v),
        (5, Value::Fixed32(v)) => fields.step = Some(v),
        (7, Value::Bytes(v)) => fields.camera = Some(v),
        (TRIGGER, Value::Fixed64(v)) => fields.trigger = Some(v),
        (BLOCK, Value::Fixed64(v)) => fields.block = Some(v),
        (CAMERA_TIME, Value::Fixed64(v)) => fields.camera_time = Some(v),
        (HOST_TIME, Value::Fixed64(v)) => fields.host_time = Some(v),
        (PIXELS_CRC, Value::Fixed32(v)) => fields.pixels_crc = Some(v),
        (SESSION, Value::Fixed64(v)) => fields.session = Some(v),
        (ENVELOPE_CRC, Value::Fixed32(v)) => fields.envelope_crc = Some((v, start)),
        // The timestamp repeats the host time; fields of later versions are skipped.
        _ => {}
    }
}

fn finish<'a>(
    fields: &Fields<'a>,
    message: &'a [u8],
    pixels: Range<usize>,
) -> Result<Envelope<'a>, EnvelopeError> {
    fn need<T>(field: &'static str, value: Option<T>) -> Result<T, EnvelopeError> {
        value.ok_or_else(|| field_error(field, "absent", "present"))
    }
    let (stated, covered) = need("envelope_crc", fields.envelope_crc)?;
    let found = crc32fast::hash(message.get(..covered).unwrap_or_default());
    if found != stated {
        return Err(EnvelopeError::Checksum { found, stated });
    }
    let (width, height) = (need("width", fields.width)?, need("height", fields.height)?);
    let encoding = need("encoding", fields.encoding)?;
    if encoding != ENCODING {
        return Err(field_error("encoding", String::from_utf8_lossy(encoding), "mono8"));
    }
    let step = need("step", fields.step)?;
    if step != width {
        return Err(field_error("step", step.to_string(), format!("the width, {width}")));
    }
    let expected = u64::from(width) * u64::from(height);
    if pixels.len() as u64 != expected {
        let (found, expected) =
            (format!("{} bytes", pixels.len()), format!("{expected} ({width} x {height})"));
        return Err(field_error("data", found, expected));
    }
    let name = need("frame_id", fields.camera)?;
    let camera = std::str::from_utf8(name).map_err(|_| field_error("frame_id", "not UTF-8", "a name"))?;
    let meta = FrameMeta {
        trigger: TriggerIndex(need("trigger_index", fields.trigger)?),
        block: BlockId(need("block_id", fields.block)?),
        camera_time_ns: need("camera_time_ns", fields.camera_time)?,
        host_time_ns: need("host_time_ns", fields.host_time)?,
        width,
        height,
        pixels_crc: need("pixels_crc32", fields.pixels_crc)?,
    };
    Ok(Envelope { camera, meta, session: fields.session.map(SessionMark), pixels })
}

/// The schema that goes into the recording: a `FileDescriptorSet` of the message and of the timestamp.
pub fn schema() -> Vec<u8> {
    let image = protobuf::describe(
        "RawImage",
        &[
            ("timestamp", 1, Kind::Message(".google.protobuf.Timestamp")),
            ("frame_id", 7, Kind::Text),
            ("width", 2, Kind::Fixed32),
            ("height", 3, Kind::Fixed32),
            ("encoding", 4, Kind::Text),
            ("step", 5, Kind::Fixed32),
            ("data", 6, Kind::Bytes),
            ("trigger_index", TRIGGER, Kind::Fixed64),
            ("block_id", BLOCK, Kind::Fixed64),
            ("camera_time_ns", CAMERA_TIME, Kind::Fixed64),
            ("host_time_ns", HOST_TIME, Kind::Fixed64),
            ("pixels_crc32", PIXELS_CRC, Kind::Fixed32),
            ("envelope_crc32", ENVELOPE_CRC, Kind::Fixed32),
            ("padding", PADDING, Kind::Bytes),
            ("session_mark", SESSION, Kind::Fixed64),
        ],
    );
    let imports = ["google/protobuf/timestamp.proto"];
    protobuf::file_set([protobuf::file("foxglove/RawImage.proto", "foxglove", &imports, vec![image])])
}

#[cfg(test)]
mod tests {
    use super::{ENVELOPE_CAPACITY, EnvelopeError, FrameMeta, parse_envelope, pixels_crc, write_envelope};
    use crate::base::ids::{BlockId, CameraId, TriggerIndex};
    use crate::belonging::SessionMark;
    use proptest::prelude::*;

    fn message(camera: &str, meta: &FrameMeta, pixels: &[u8]) -> Vec<u8> {
        let mut buffer = vec![0xEE; ENVELOPE_CAPACITY];
        buffer.extend_from_slice(pixels);
        let length = write_envelope(&mut buffer[..ENVELOPE_CAPACITY], &CameraId::from(camera), meta);
        buffer.split_off(ENVELOPE_CAPACITY - length.expect("room enough"))
    }

    fn sample() -> (FrameMeta, Vec<u8>) {
        let pixels = vec![10, 20, 30, 40, 50, 60];
        let meta = FrameMeta {
            trigger: TriggerIndex(300),
            block: BlockId(7),
            camera_time_ns: 0x0102_0304,
            host_time_ns: 2_000_000_005,
            width: 3,
            height: 2,
            pixels_crc: pixels_crc(&pixels),
        };
        (meta, pixels)
    }

    /// Version 2 adds the session's mark, in front of the checksum.
    #[test]
    fn golden_bytes_of_a_marked_message() {
        let (meta, pixels) = sample();
        let bare = message("h0", &meta, &pixels);
        let marked = super::marked(SessionMark(0x0102_0304_0506_0708), &bare).expect("a message");
        let at = bare.len() - pixels.len() - 8;
        assert_eq!(marked[..at], bare[..at]);
        assert_eq!(marked[at..at + 10], [0x81, 0x3f, 8, 7, 6, 5, 4, 3, 2, 1], "session_mark");
        assert_eq!(marked[at + 10..at + 12], [0xf5, 0x3e], "the checksum covers it");
        assert_eq!(marked[at + 16..], [0x32, 6, 10, 20, 30, 40, 50, 60]);
        let found = parse_envelope(&marked).expect("readable");
        assert_eq!((found.meta, found.session), (meta, Some(SessionMark(0x0102_0304_0506_0708))));
        assert_eq!(parse_envelope(&bare).expect("readable").session, None);
    }

    /// Version 1 of the format; a change here is a new version.
    #[test]
    fn golden_bytes() {
        let (meta, pixels) = sample();
        #[rustfmt::skip]
        let expected: &[u8] = &[
            0x0a, 4, 0x08, 2, 0x10, 5,                      // timestamp { seconds: 2, nanos: 5 }
            0x15, 3, 0, 0, 0, 0x1d, 2, 0, 0, 0,             // width, height
            0x22, 5, b'm', b'o', b'n', b'o', b'8',          // encoding
            0x2d, 3, 0, 0, 0,                               // step
            0x3a, 2, b'h', b'0',                            // frame_id
            0xc9, 0x3e, 0x2c, 1, 0, 0, 0, 0, 0, 0,          // trigger_index
            0xd1, 0x3e, 7, 0, 0, 0, 0, 0, 0, 0,             // block_id
            0xd9, 0x3e, 4, 3, 2, 1, 0, 0, 0, 0,             // camera_time_ns
            0xe1, 0x3e, 5, 0x94, 0x35, 0x77, 0, 0, 0, 0,    // host_time_ns
        ];
        let found = message("h0", &meta, &pixels);
        assert_eq!(&found[..expected.len()], expected);
        let tail = &found[expected.len()..];
        assert_eq!((&tail[..2], &tail[6..8]), (&[0xed, 0x3e][..], &[0xf5, 0x3e][..]), "both checksums");
        assert_eq!(&tail[12..], [0x32, 6, 10, 20, 30, 40, 50, 60], "pixels are the last field");
    }

    #[test]
    fn every_bit_flip_before_the_pixels_is_found() {
        let (meta, pixels) = sample();
        let good = message("h0_up", &meta, &pixels);
        for bit in 0..(good.len() - pixels.len()) * 8 {
            let mut bad = good.clone();
            bad[bit / 8] ^= 1 << (bit % 8);
            assert!(parse_envelope(&bad).is_err(), "bit {bit}");
        }
    }

    #[test]
    fn too_little_room_is_an_error() {
        let (meta, _) = sample();
        let error = write_envelope(&mut [0; 20], &CameraId::from("h0"), &meta);
        assert!(matches!(error, Err(EnvelopeError::Room { room: 20, .. })), "{error:?}");
    }

    #[test]
    fn the_longest_envelope_fits() {
        let most = u64::MAX;
        let (trigger, block) = (TriggerIndex(most), BlockId(most));
        let (width, height, pixels_crc) = (u32::MAX, u32::MAX, u32::MAX);
        let meta =
            FrameMeta { trigger, block, camera_time_ns: most, host_time_ns: most, width, height, pixels_crc };
        let name = CameraId("x".repeat(crate::layout::MAX_CAMERA_NAME));
        let length = write_envelope(&mut [0; ENVELOPE_CAPACITY], &name, &meta).expect("room enough");
        assert!(length < ENVELOPE_CAPACITY, "{length} bytes could have been cut");
    }

    #[test]
    fn padded_to_any_length_it_reads_back_and_no_flip_is_missed() {
        let (meta, pixels) = sample();
        let camera = CameraId::from("h0_up");
        let lengths = super::padded_lengths(Some(SessionMark(7)), &camera, &meta).expect("an envelope");
        for length in lengths.clone().step_by(7).chain([*lengths.start() + 124, *lengths.end()]) {
            let mut message = vec![0xEE; 4096];
            super::write_padded_envelope(&mut message, Some(SessionMark(7)), &camera, &meta, length)
                .expect("a possible length");
            message.extend_from_slice(&pixels);
            let mut message = message.split_off(4096 - length);
            let found = parse_envelope(&message).expect("readable");
            assert_eq!((found.meta, found.pixels), (meta, length..length + pixels.len()));
            for at in (0..length).step_by(5) {
                message[at] ^= 4;
                assert!(parse_envelope(&message).is_err(), "byte {at} of {length}");
                message[at] ^= 4;
            }
        }
        for impossible in [*lengths.start() - 1, *lengths.end() + 1] {
            let error = super::write_padded_envelope(
                &mut [0; 4096],
                Some(SessionMark(7)),
                &camera,
                &meta,
                impossible,
            );
            assert!(matches!(error, Err(EnvelopeError::Room { .. })), "{impossible}: {error:?}");
        }
    }

    proptest! {
        #[test]
        fn it_reads_back(trigger: u64, block: u64, camera_time_ns: u64, host_time_ns: u64,
                         width in 1u32..40, height in 1u32..40, name in "[a-z0-9_]{1,64}") {
            let pixels: Vec<u8> = (0..width * height).map(|i| i as u8).collect();
            let pixels_crc = pixels_crc(&pixels);
            let (trigger, block) = (TriggerIndex(trigger), BlockId(block));
            let meta = FrameMeta { trigger, block, camera_time_ns, host_time_ns, width, height, pixels_crc };
            let message = message(&name, &meta, &pixels);
            let envelope = parse_envelope(&message).expect("just written");
            prop_assert_eq!(envelope.camera, name.as_str());
            prop_assert_eq!(envelope.meta, meta);
            prop_assert_eq!(&message[envelope.pixels], pixels.as_slice());
        }

        #[test]
        fn any_bytes_are_refused_or_read(bytes: Vec<u8>) {
            let _ = parse_envelope(&bytes);
        }

        #[test]
        fn cut_messages_are_refused(cut in 0usize..100) {
            let (meta, pixels) = sample();
            let good = message("h0", &meta, &pixels);
            prop_assume!(cut < good.len());
            prop_assert!(parse_envelope(&good[..cut]).is_err());
        }
    }
}
