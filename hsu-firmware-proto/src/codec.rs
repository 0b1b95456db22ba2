// SPDX-License-Identifier: MIT OR Apache-2.0
//! Fixed-width little-endian fields to bytes and back.

use crate::MAX_MESSAGE;
use core::fmt;

/// Why a message cannot be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DecodeError {
    /// Shorter or longer than its kind has it.
    Length,
    /// Written in a version that this end does not speak.
    Version {
        /// The version that was found.
        found: u8,
    },
    /// A kind that this version does not have.
    Kind {
        /// The kind that was found.
        found: u8,
    },
    /// A code outside its range.
    Value,
}

impl fmt::Display for DecodeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Length => f.write_str("message is longer or shorter than its kind"),
            Self::Version { found } => write!(
                f,
                "message has protocol version {found}, expected {} to {}",
                crate::version::MIN,
                crate::version::CURRENT
            ),
            Self::Kind { found } => write!(f, "message kind {found:#04x} is not known"),
            Self::Value => f.write_str("message holds a code outside its range"),
        }
    }
}

#[cfg(feature = "std")]
impl std::error::Error for DecodeError {}

/// Writes fields into a message buffer.
pub(crate) struct Put<'a> {
    buffer: &'a mut [u8; MAX_MESSAGE],
    length: usize,
}

impl<'a> Put<'a> {
    pub(crate) fn new(buffer: &'a mut [u8; MAX_MESSAGE]) -> Self {
        Self { buffer, length: 0 }
    }

    /// The golden tests prove that the longest message fits; a longer one would be cut, not panic in the unit.
    pub(crate) fn bytes(&mut self, bytes: &[u8]) {
        let end = self.length + bytes.len();
        debug_assert!(end <= MAX_MESSAGE, "message of more than {MAX_MESSAGE} bytes");
        if let Some(room) = self.buffer.get_mut(self.length..end) {
            room.copy_from_slice(bytes);
            self.length = end;
        }
    }

    pub(crate) fn u8(&mut self, value: u8) {
        self.bytes(&[value]);
    }

    pub(crate) fn u16(&mut self, value: u16) {
        self.bytes(&value.to_le_bytes());
    }

    pub(crate) fn u32(&mut self, value: u32) {
        self.bytes(&value.to_le_bytes());
    }

    pub(crate) fn u64(&mut self, value: u64) {
        self.bytes(&value.to_le_bytes());
    }

    pub(crate) fn i64(&mut self, value: i64) {
        self.bytes(&value.to_le_bytes());
    }

    pub(crate) fn length(&self) -> usize {
        self.length
    }
}

/// Reads fields off the front of a message.
pub(crate) struct Take<'a>(&'a [u8]);

impl<'a> Take<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self(bytes)
    }

    pub(crate) fn array<const N: usize>(&mut self) -> Result<[u8; N], DecodeError> {
        let (head, rest) = self.0.split_first_chunk().ok_or(DecodeError::Length)?;
        self.0 = rest;
        Ok(*head)
    }

    pub(crate) fn u8(&mut self) -> Result<u8, DecodeError> {
        self.array::<1>().map(|[byte]| byte)
    }

    pub(crate) fn u16(&mut self) -> Result<u16, DecodeError> {
        self.array().map(u16::from_le_bytes)
    }

    pub(crate) fn u32(&mut self) -> Result<u32, DecodeError> {
        self.array().map(u32::from_le_bytes)
    }

    pub(crate) fn u64(&mut self) -> Result<u64, DecodeError> {
        self.array().map(u64::from_le_bytes)
    }

    pub(crate) fn i64(&mut self) -> Result<i64, DecodeError> {
        self.array().map(i64::from_le_bytes)
    }

    /// Nothing may follow the last field.
    pub(crate) fn end(self) -> Result<(), DecodeError> {
        if self.0.is_empty() { Ok(()) } else { Err(DecodeError::Length) }
    }
}
