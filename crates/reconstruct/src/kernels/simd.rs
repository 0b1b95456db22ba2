// SPDX-License-Identifier: MIT OR Apache-2.0
//! One build for every processor: a stage's loops run with the widest vectors that the processor has.
//!
//! Loops are written plainly, over slices, and the compiler makes vectors of them. Neither it nor this code fuses or
//! reorders floating-point operations, so the bytes that come out are the same at every width (test `it::simd_paths`).
//! The closure and what is called inside have to be `#[inline(always)]`: what stays a call is compiled for the
//! narrowest processor, without a warning. So do `array::map`, `array::from_fn` and `Vec::extend` with a closure.
//!
//! `FOURDBODY_SIMD=portable`, `avx2` or `avx512` takes at most that width, for measurements and tests.

use pulp::Arch;
use std::sync::OnceLock;

/// Runs `work` compiled for this processor.
#[inline]
pub fn dispatch<R>(work: impl FnOnce() -> R) -> R {
    static ARCH: OnceLock<Arch> = OnceLock::new();
    ARCH.get_or_init(|| at_most(std::env::var("FOURDBODY_SIMD").ok().as_deref())).dispatch(work)
}

/// The widest vectors that the processor has and the user allows.
#[cfg(target_arch = "x86_64")]
fn at_most(limit: Option<&str>) -> Arch {
    use pulp::x86::V3;
    match limit {
        None | Some("avx512") => Arch::new(),
        Some("avx2") => V3::try_new().map_or(Arch::Scalar, Arch::V3),
        Some(_) => Arch::Scalar,
    }
}

/// The compiler's own vectors: there is nothing to choose from.
#[cfg(not(target_arch = "x86_64"))]
fn at_most(_: Option<&str>) -> Arch {
    Arch::new()
}
