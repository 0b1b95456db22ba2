// SPDX-License-Identifier: MIT OR Apache-2.0
//! The part of protobuf that recordings and results need: a writer, a bounded reader, and descriptors.
//!
//! Wire format: <https://protobuf.dev/programming-guides/encoding/>. Descriptors:
//! `google/protobuf/descriptor.proto`, whose field numbers are named where they are used.

use std::io::{Cursor, Write};

/// Wire types of fields, as the encoding numbers them.
const VARINT: u64 = 0;
const I64: u64 = 1;
const LEN: u64 = 2;
const I32: u64 = 5;

/// Memory for a short message without allocation. What exceeds `N` bytes is dropped: the owner chooses `N` to suffice.
pub type Fixed<const N: usize> = Cursor<[u8; N]>;

/// The bytes that were written to fixed memory.
pub fn written<const N: usize>(memory: &Fixed<N>) -> &[u8] {
    &memory.get_ref()[..memory.position() as usize]
}

/// A message under construction, in a `Vec` or in [`Fixed`] memory.
#[derive(Default)]
pub struct MessageWriter<B = Vec<u8>>(B);

impl<const N: usize> MessageWriter<Fixed<N>> {
    /// Begins a message in fixed memory.
    pub fn fixed() -> Self {
        Self(Cursor::new([0; N]))
    }
}

impl<B: Write> MessageWriter<B> {
    /// The bytes of the message so far.
    pub fn into_bytes(self) -> B {
        self.0
    }

    fn append(&mut self, bytes: &[u8]) {
        // A `Vec` takes everything, fixed memory what fits.
        let _ = self.0.write_all(bytes);
    }

    fn raw_varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.append(&[value as u8 | 0x80]);
            value >>= 7;
        }
        self.append(&[value as u8]);
    }

    fn number(mut self, field: u32, wire: u64, value: &[u8]) -> Self {
        self.raw_varint(u64::from(field) << 3 | wire);
        self.append(value);
        self
    }

    /// An `int32`, `int64`, `uint32`, `uint64`, `bool` or enumeration field that is not negative.
    pub fn varint(self, field: u32, value: u64) -> Self {
        let mut message = self.number(field, VARINT, &[]);
        message.raw_varint(value);
        message
    }

    /// Appends a `fixed32` field, little-endian.
    pub fn fixed32(self, field: u32, value: u32) -> Self {
        self.number(field, I32, &value.to_le_bytes())
    }

    /// Appends a `fixed64` field, little-endian.
    pub fn fixed64(self, field: u32, value: u64) -> Self {
        self.number(field, I64, &value.to_le_bytes())
    }

    /// Appends a `double` field, little-endian.
    pub fn double(self, field: u32, value: f64) -> Self {
        self.number(field, I64, &value.to_le_bytes())
    }

    /// A `string`, `bytes` or message field.
    pub fn bytes(self, field: u32, value: &[u8]) -> Self {
        let mut message = self.bytes_header(field, value.len() as u64);
        message.append(value);
        message
    }

    /// Tag and length of a `bytes` field whose value is written elsewhere.
    pub fn bytes_header(self, field: u32, length: u64) -> Self {
        let mut message = self.number(field, LEN, &[]);
        message.raw_varint(length);
        message
    }
}

impl MessageWriter {
    /// A field that is a message.
    pub fn message(self, field: u32, value: Self) -> Self {
        self.bytes(field, &value.0)
    }
}

/// The value of a field, by its wire type.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Value<'a> {
    Varint(u64),
    Fixed32(u32),
    Fixed64(u64),
    /// A string, bytes or a message.
    Bytes(&'a [u8]),
}

/// Reads a message field by field, without allocating.
pub(crate) struct MessageReader<'a> {
    message: &'a [u8],
    position: usize,
}

impl<'a> MessageReader<'a> {
    /// Reads `message` from its start.
    pub fn new(message: &'a [u8]) -> Self {
        Self { message, position: 0 }
    }

    /// Bytes of the message that were read so far.
    pub fn position(&self) -> usize {
        self.position
    }

    fn take(&mut self, count: u64) -> Option<&'a [u8]> {
        let end = self.position.checked_add(usize::try_from(count).ok()?)?;
        let taken = self.message.get(self.position..end)?;
        self.position = end;
        Some(taken)
    }

    fn raw_varint(&mut self) -> Option<u64> {
        let mut value = 0u64;
        for shift in (0..64).step_by(7) {
            let byte = *self.take(1)?.first()?;
            let bits = u64::from(byte & 0x7f);
            if shift == 63 && bits > 1 {
                return None;
            }
            value |= bits << shift;
            if byte < 0x80 {
                return Some(value);
            }
        }
        None
    }

    /// The next field and its value; `Ok(None)` at the end, `Err` where the bytes are not a message.
    pub fn next_field(&mut self) -> Result<Option<(u64, Value<'a>)>, ()> {
        if self.position >= self.message.len() {
            return Ok(None);
        }
        self.field().map(Some).ok_or(())
    }

    /// If the next field is this one, of bytes: their length, of which nothing is read. Stays in front of any other
    /// field.
    pub fn enter_bytes(&mut self, number: u64) -> Option<u64> {
        let start = self.position;
        let tag = self.raw_varint();
        let length = tag.filter(|tag| *tag == number << 3 | LEN).and_then(|_| self.raw_varint());
        if length.is_none() {
            self.position = start;
        }
        length
    }

    fn field(&mut self) -> Option<(u64, Value<'a>)> {
        let tag = self.raw_varint()?;
        let value = match tag & 7 {
            VARINT => Value::Varint(self.raw_varint()?),
            I64 => Value::Fixed64(u64::from_le_bytes(self.take(8)?.try_into().ok()?)),
            I32 => Value::Fixed32(u32::from_le_bytes(self.take(4)?.try_into().ok()?)),
            LEN => {
                let length = self.raw_varint()?;
                Value::Bytes(self.take(length)?)
            }
            _ => return None,
        };
        Some((tag >> 3, value))
    }
}

/// Type of a field. Messages and enumerations carry the full name of their type.
#[derive(Clone, Copy)]
pub enum Kind {
    Double,
    Int64,
    Int32,
    Fixed64,
    Fixed32,
    Text,
    Bytes,
    Message(&'static str),
    Repeated(&'static str),
    Enum(&'static str),
}

impl Kind {
    /// Label (1 optional, 3 repeated), number in `FieldDescriptorProto.Type`, and the name of its type.
    fn descriptor(self) -> (u64, u64, Option<&'static str>) {
        match self {
            Self::Double => (1, 1, None),
            Self::Int64 => (1, 3, None),
            Self::Int32 => (1, 5, None),
            Self::Fixed64 => (1, 6, None),
            Self::Fixed32 => (1, 7, None),
            Self::Text => (1, 9, None),
            Self::Bytes => (1, 12, None),
            Self::Message(name) => (1, 11, Some(name)),
            Self::Repeated(name) => (3, 11, Some(name)),
            Self::Enum(name) => (1, 14, Some(name)),
        }
    }
}

/// Describes a message by name, number and type of its fields (`DescriptorProto`: name 1, field 2;
/// `FieldDescriptorProto`: name 1, number 3, label 4, type 5, type name 6).
pub fn describe(name: &str, fields: &[(&str, u32, Kind)]) -> MessageWriter {
    let message = MessageWriter::default().bytes(1, name.as_bytes());
    fields.iter().fold(message, |message, (name, number, kind)| {
        let (label, number_of_type, type_name) = kind.descriptor();
        let field = MessageWriter::default().bytes(1, name.as_bytes()).varint(3, u64::from(*number));
        let field = field.varint(4, label).varint(5, number_of_type);
        message.message(2, type_name.into_iter().fold(field, |field, name| field.bytes(6, name.as_bytes())))
    })
}

/// Describes a proto3 file (`FileDescriptorProto`: name 1, package 2, dependency 3, message type 4, syntax 12).
pub fn file(path: &str, package: &str, imports: &[&str], messages: Vec<MessageWriter>) -> MessageWriter {
    let file = MessageWriter::default().bytes(1, path.as_bytes()).bytes(2, package.as_bytes());
    let file = imports.iter().fold(file, |file, import| file.bytes(3, import.as_bytes()));
    messages.into_iter().fold(file, |file, message| file.message(4, message)).bytes(12, b"proto3")
}

/// A `FileDescriptorSet` (file 1) of these files, behind that of `google.protobuf.Timestamp`, which all of them import.
pub fn file_set(files: impl IntoIterator<Item = MessageWriter>) -> Vec<u8> {
    let timestamp = describe("Timestamp", &[("seconds", 1, Kind::Int64), ("nanos", 2, Kind::Int32)]);
    let timestamp = file("google/protobuf/timestamp.proto", "google.protobuf", &[], vec![timestamp]);
    let files = std::iter::once(timestamp).chain(files);
    files.fold(MessageWriter::default(), |set, file| set.message(1, file)).0
}

/// A time as `google.protobuf.Timestamp`, in whichever memory.
pub fn timestamp<B: Write>(message: MessageWriter<B>, time_ns: u64) -> MessageWriter<B> {
    message.varint(1, time_ns / 1_000_000_000).varint(2, time_ns % 1_000_000_000)
}

#[cfg(test)]
mod tests {
    use super::{MessageReader, MessageWriter, Value};
    use proptest::prelude::*;

    #[test]
    fn golden_bytes_of_the_encoding_guide() {
        // The guide's own examples: field 1 = varint 150; field 2 = string "testing".
        let message = <MessageWriter>::default().varint(1, 150).bytes(2, b"testing").into_bytes();
        assert_eq!(message, b"\x08\x96\x01\x12\x07testing");
    }

    proptest! {
        #[test]
        fn fields_read_back(a: u64, b: u32, c: u64, text: Vec<u8>, number in 1u32..(1 << 29)) {
            let writer = <MessageWriter>::default().varint(number, a).fixed32(2, b).fixed64(3, c).bytes(4, &text);
            let message = writer.into_bytes();
            let mut reader = MessageReader::new(&message);
            prop_assert_eq!(reader.next_field(), Ok(Some((number.into(), Value::Varint(a)))));
            prop_assert_eq!(reader.next_field(), Ok(Some((2, Value::Fixed32(b)))));
            prop_assert_eq!(reader.next_field(), Ok(Some((3, Value::Fixed64(c)))));
            prop_assert_eq!(reader.next_field(), Ok(Some((4, Value::Bytes(&text)))));
            prop_assert_eq!(reader.next_field(), Ok(None));
        }

        #[test]
        fn any_bytes_end(bytes: Vec<u8>) {
            let mut reader = MessageReader::new(&bytes);
            let mut before = 0;
            while let Ok(Some(_)) = reader.next_field() {
                prop_assert!(reader.position() > before && reader.position() <= bytes.len());
                before = reader.position();
            }
        }
    }
}
