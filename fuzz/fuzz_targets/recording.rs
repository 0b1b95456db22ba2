// SPDX-License-Identifier: MIT OR Apache-2.0
//! Fuzz target `recording`; what it does is in `fuzz/src`.

#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| fourdbody_fuzz::recording::reader(data));
