// SPDX-License-Identifier: MIT OR Apache-2.0
//! What runs over copper in the laboratory: the trigger wires from the HSU to the cameras.

use std::time::Instant;

/// One rising edge on a camera's trigger input.
#[derive(Debug, Clone, Copy)]
pub struct TriggerEdge {
    /// Which instant of the simulated world it falls on: the trigger's index in its train. The camera does
    /// not learn it; it only picks the light that reaches the sensor. Negative for warm-up triggers.
    pub instant: i64,
    pub time: Instant,
    /// How long the HSU holds the line, ns: the exposure, where a camera is set to trigger width.
    pub width_ns: u64,
}
