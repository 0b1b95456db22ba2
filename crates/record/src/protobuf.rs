// SPDX-License-Identifier: MIT OR Apache-2.0
//! The little of protobuf that a recording needs: a writer, a bounded reader, and descriptors.
//!
//! Wire format: <https://protobuf.dev/programming-guides/encoding/>. Descriptors:
//! `google/protobuf/descriptor.proto`, whose field numbers are named where they are used.

/// Wire types.
const VARINT: u64 = 0;
const I64: u64 = 1;
const LEN: u64 = 2;
const I32: u64 = 5;

/// Where a message under construction grows.
pub trait Buffer: Default {
    /// Appends bytes.
    fn append(&mut self, bytes: &[u8]);
    /// Everything appended.
    fn as_slice(&self) -> &[u8];
}

impl Buffer for Vec<u8> {
    fn append(&mut self, bytes: &[u8]) {
        self.extend_from_slice(bytes);
    }

    fn as_slice(&self) -> &[u8] {
        self
    }
}

/// At most `N` bytes without allocation; what is beyond is dropped, so the owner chooses `N` with care.
pub struct Fixed<const N: usize> {
    bytes: [u8; N],
    length: usize,
}

impl<const N: usize> Default for Fixed<N> {
    fn default() -> Self {
        Self { bytes: [0; N], length: 0 }
    }
}

impl<const N: usize> Buffer for Fixed<N> {
    fn append(&mut self, bytes: &[u8]) {
        let fitting = bytes.len().min(N - self.length);
        self.bytes[self.length..self.length + fitting].copy_from_slice(&bytes[..fitting]);
        self.length += fitting;
    }

    fn as_slice(&self) -> &[u8] {
        &self.bytes[..self.length]
    }
}

/// A message under construction.
#[derive(Default)]
pub struct MessageWriter<B = Vec<u8>> {
    bytes: B,
}

impl<B: Buffer> MessageWriter<B> {
    /// The encoded message.
    pub fn into_bytes(self) -> B {
        self.bytes
    }

    fn raw_varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.bytes.append(&[value as u8 | 0x80]);
            value >>= 7;
        }
        self.bytes.append(&[value as u8]);
    }

    fn tag(&mut self, field: u32, wire: u64) {
        self.raw_varint(u64::from(field) << 3 | wire);
    }

    /// An `int32`, `int64`, `uint32`, `uint64`, `bool` or enumeration field that is not negative.
    pub fn varint(mut self, field: u32, value: u64) -> Self {
        self.tag(field, VARINT);
        self.raw_varint(value);
        self
    }

    /// A `fixed32` field.
    pub fn fixed32(mut self, field: u32, value: u32) -> Self {
        self.tag(field, I32);
        self.bytes.append(&value.to_le_bytes());
        self
    }

    /// A `fixed64` field.
    pub fn fixed64(mut self, field: u32, value: u64) -> Self {
        self.tag(field, I64);
        self.bytes.append(&value.to_le_bytes());
        self
    }

    /// A `string`, `bytes` or message field.
    pub fn bytes(mut self, field: u32, value: &[u8]) -> Self {
        self = self.bytes_header(field, value.len() as u64);
        self.bytes.append(value);
        self
    }

    /// What stands in front of a `bytes` field whose value follows elsewhere.
    pub fn bytes_header(mut self, field: u32, length: u64) -> Self {
        self.tag(field, LEN);
        self.raw_varint(length);
        self
    }
}

/// A field's value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Value<'a> {
    /// Any varint.
    Varint(u64),
    /// `fixed32` and its kin.
    Fixed32(u32),
    /// `fixed64` and its kin.
    Fixed64(u64),
    /// A string, bytes or a message.
    Bytes(&'a [u8]),
}

/// Reads a message field by field, without allocating.
pub struct MessageReader<'a> {
    message: &'a [u8],
    position: usize,
}

impl<'a> MessageReader<'a> {
    /// Reads `message` from its start.
    pub fn new(message: &'a [u8]) -> Self {
        Self { message, position: 0 }
    }

    /// Bytes read so far.
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

    /// If the next field is this one, of bytes: their length, of which nothing is read. Stays in front of any other field.
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

/// Type of a field, as `FieldDescriptorProto.Type` numbers them.
#[derive(Clone, Copy)]
pub enum FieldType {
    /// `int64`.
    Int64 = 3,
    /// `int32`.
    Int32 = 5,
    /// `fixed64`.
    Fixed64 = 6,
    /// `fixed32`.
    Fixed32 = 7,
    /// `string`.
    String = 9,
    /// `bytes`.
    Bytes = 12,
}

/// Describes a singular field (`FieldDescriptorProto`: name 1, number 3, label 4, type 5).
pub fn field(name: &str, number: u32, kind: FieldType) -> Vec<u8> {
    let message = <MessageWriter>::default().bytes(1, name.as_bytes()).varint(3, number.into());
    message.varint(4, 1).varint(5, kind as u64).into_bytes()
}

/// Describes a singular field that is a message (`FieldDescriptorProto`: type 11, type name 6).
pub fn message_field(name: &str, number: u32, type_name: &str) -> Vec<u8> {
    let message = <MessageWriter>::default().bytes(1, name.as_bytes()).varint(3, number.into());
    message.varint(4, 1).varint(5, 11).bytes(6, type_name.as_bytes()).into_bytes()
}

/// Describes a proto3 file with one message (`FileDescriptorProto`: name 1, package 2, dependency 3, message
/// type 4, syntax 12; `DescriptorProto`: name 1, field 2).
pub fn file(path: &str, package: &str, imports: &[&str], message: &str, fields: &[Vec<u8>]) -> Vec<u8> {
    let mut descriptor = <MessageWriter>::default().bytes(1, message.as_bytes());
    for field in fields {
        descriptor = descriptor.bytes(2, field);
    }
    let mut file = <MessageWriter>::default().bytes(1, path.as_bytes()).bytes(2, package.as_bytes());
    for import in imports {
        file = file.bytes(3, import.as_bytes());
    }
    file.bytes(4, &descriptor.into_bytes()).bytes(12, b"proto3").into_bytes()
}

/// A `FileDescriptorSet` (file 1).
pub fn file_set(files: &[Vec<u8>]) -> Vec<u8> {
    files.iter().fold(<MessageWriter>::default(), |set, file| set.bytes(1, file)).into_bytes()
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
