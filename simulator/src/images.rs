// SPDX-License-Identifier: MIT OR Apache-2.0
//! The light that reaches one camera's sensor.

/// Images of one camera by instant of the simulated world. Shared by threads; must not block for long.
pub trait ImageSource: Send + Sync {
    /// Columns and rows of every image.
    fn size(&self) -> (usize, usize);

    /// Mono8 pixels, row-major, at this instant (see [`crate::wire::TriggerEdge::instant`]).
    fn pixels(&self, instant: i64) -> &[u8];
}
