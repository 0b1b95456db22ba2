// SPDX-License-Identifier: MIT OR Apache-2.0
//! Frames on a serial line: `0x00, COBS(message ++ CRC-32), 0x00`.
//!
//! Consistent overhead byte stuffing (Cheshire and Baker, 1999) takes every zero out of the body, so a zero
//! is always a frame's edge and a receiver finds the next frame after any corruption. The zero in *front*
//! means that garbage on the line never costs the intact frame behind it. The CRC is CRC-32/ISO-HDLC,
//! little-endian, over the message. It starts from ones and so takes ones at the front for nothing: the CRC of
//! `ff` is `00 00 00 ff`, that of `ff ff` is `00 00 ff ff`, and a message that went on so could be cut short
//! and still pass. No message begins with 0xff, then ([`NO_MESSAGE`]).

use crate::MAX_MESSAGE;

const CRC_BYTES: usize = 4;
/// Stuffed body: at most 254 bytes go under one COBS code byte.
const MAX_STUFFED: usize = MAX_MESSAGE + CRC_BYTES + 1;
/// Longest frame on the line, bytes.
pub const MAX_FRAME: usize = MAX_STUFFED + 2;
const DELIMITER: u8 = 0;
/// What no message begins with: the start of the CRC, which cancels it.
pub const NO_MESSAGE: u8 = 0xff;

// One code byte suffices as long as this holds.
const _: () = assert!(MAX_MESSAGE + CRC_BYTES <= 254);

/// CRC-32/ISO-HDLC (polynomial 0x04C11DB7, reflected), four bits at a time: a 64-byte table suits firmware.
pub fn crc32(bytes: &[u8]) -> u32 {
    let mut crc = !0u32;
    for &byte in bytes {
        crc = CRC_TABLE[((crc ^ u32::from(byte)) & 0xf) as usize] ^ (crc >> 4);
        crc = CRC_TABLE[((crc ^ u32::from(byte >> 4)) & 0xf) as usize] ^ (crc >> 4);
    }
    !crc
}

const CRC_TABLE: [u32; 16] = {
    let mut table = [0u32; 16];
    let mut i = 0;
    while i < 16 {
        let mut value = i as u32;
        let mut bit = 0;
        while bit < 4 {
            value = if value & 1 == 1 { (value >> 1) ^ 0xedb8_8320 } else { value >> 1 };
            bit += 1;
        }
        table[i] = value;
        i += 1;
    }
    table
};

/// Frames a message; returns the frame's length. No bytes, more than [`MAX_MESSAGE`], or [`NO_MESSAGE`] at the
/// front give 0.
pub fn encode(message: &[u8], out: &mut [u8; MAX_FRAME]) -> usize {
    if message.is_empty() || message.len() > MAX_MESSAGE || message[0] == NO_MESSAGE {
        return 0;
    }
    let crc = crc32(message).to_le_bytes();
    out[0] = DELIMITER;
    let mut code_at = 1;
    let mut at = 2;
    for &byte in message.iter().chain(&crc) {
        if byte == 0 {
            out[code_at] = (at - code_at) as u8;
            code_at = at;
        } else {
            out[at] = byte;
        }
        at += 1;
    }
    out[code_at] = (at - code_at) as u8;
    out[at] = DELIMITER;
    at + 1
}

/// What a decoder had to throw away.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FrameErrors {
    /// Bodies whose CRC does not match, or says too little: those that begin with [`NO_MESSAGE`].
    pub crc: u32,
    /// Bodies that are no valid stuffing, or too short for a CRC.
    pub stuffing: u32,
    /// Bodies longer than any frame.
    pub too_long: u32,
}

impl FrameErrors {
    /// How many frames were dropped, for all reasons together.
    pub fn total(&self) -> u32 {
        self.crc.saturating_add(self.stuffing).saturating_add(self.too_long)
    }
}

/// Finds messages in a stream of bytes, in any portions; holds one frame and allocates nothing.
#[derive(Debug, Clone)]
pub struct Decoder {
    buffer: [u8; MAX_STUFFED],
    length: usize,
    too_long: bool,
    errors: FrameErrors,
}

impl Default for Decoder {
    fn default() -> Self {
        Self::new()
    }
}

impl Decoder {
    /// A decoder that has not received any byte.
    pub const fn new() -> Self {
        let errors = FrameErrors { crc: 0, stuffing: 0, too_long: 0 };
        Self { buffer: [0; MAX_STUFFED], length: 0, too_long: false, errors }
    }

    /// Frames thrown away so far.
    pub fn errors(&self) -> FrameErrors {
        self.errors
    }

    /// Takes a portion of the stream; calls `on_message` for each message completed in it.
    pub fn feed(&mut self, bytes: &[u8], mut on_message: impl FnMut(&[u8])) {
        for &byte in bytes {
            if let Some(message) = self.push(byte) {
                on_message(message);
            }
        }
    }

    /// Takes one byte; returns the message that it completes.
    pub fn push(&mut self, byte: u8) -> Option<&[u8]> {
        if byte != DELIMITER {
            match self.buffer.get_mut(self.length) {
                Some(place) => {
                    *place = byte;
                    self.length += 1;
                }
                None => self.too_long = true,
            }
            return None;
        }
        let stuffed = core::mem::take(&mut self.length);
        if core::mem::take(&mut self.too_long) {
            self.errors.too_long = self.errors.too_long.saturating_add(1);
            return None;
        }
        // Between two frames stand two delimiters.
        if stuffed == 0 {
            return None;
        }
        // The CRC of nothing is four zeros, so a run of zeros that was cut short would pass for an empty message.
        let body = unstuff(&mut self.buffer[..stuffed]).filter(|&body| body > CRC_BYTES);
        let Some(length) = body.map(|body| body - CRC_BYTES) else {
            self.errors.stuffing = self.errors.stuffing.saturating_add(1);
            return None;
        };
        let (message, crc) = self.buffer.split_at(length);
        if message.first() == Some(&NO_MESSAGE) || crc.first_chunk() != Some(&crc32(message).to_le_bytes()) {
            self.errors.crc = self.errors.crc.saturating_add(1);
            return None;
        }
        Some(message)
    }
}

/// Takes the stuffing out in place; returns the length of the body, or `None` if the codes do not add up.
fn unstuff(bytes: &mut [u8]) -> Option<usize> {
    let mut read = 0;
    let mut write = 0;
    while read < bytes.len() {
        let code = usize::from(bytes[read]);
        let end = read + code;
        if code == 0 || end > bytes.len() {
            return None;
        }
        bytes.copy_within(read + 1..end, write);
        write += code - 1;
        // A code byte stands for the zero behind its run, except at the end and after a run of 254.
        if end < bytes.len() && code != 0xff {
            bytes[write] = 0;
            write += 1;
        }
        read = end;
    }
    Some(write)
}

#[cfg(test)]
mod tests {
    use super::crc32;

    /// The check value of CRC-32/ISO-HDLC in Ross Williams' and the reveng catalogue's convention.
    #[test]
    fn crc_has_the_catalogue_check_value() {
        assert_eq!(crc32(b"123456789"), 0xcbf4_3926);
    }
}
