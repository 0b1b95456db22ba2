// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the fuzz targets do with bytes from outside, and what must hold whatever the bytes are.
//!
//! The bodies live here, apart from the targets, so that the product's ordinary tests run every seed through
//! them without a nightly compiler (`tests/it/fuzz_corpora.rs`). A body panics when an invariant is broken.

pub mod config;
pub mod gvcp;
pub mod hsu;
pub mod reconstruct;
pub mod recording;

/// Takes values off the front of the fuzzer's bytes.
struct Script<'a>(&'a [u8]);

impl<'a> Script<'a> {
    fn byte(&mut self) -> Option<u8> {
        let (&first, rest) = self.0.split_first()?;
        self.0 = rest;
        Some(first)
    }

    fn word(&mut self) -> Option<u16> {
        Some(u16::from_le_bytes([self.byte()?, self.byte()?]))
    }

    /// As many bytes as asked for, or as there are.
    fn bytes(&mut self, count: usize) -> &'a [u8] {
        let (taken, rest) = self.0.split_at(count.min(self.0.len()));
        self.0 = rest;
        taken
    }
}
