// SPDX-License-Identifier: MIT OR Apache-2.0
//! Edges of the unit's input lines: a force plate, a recorder of muscles, a hand switch. They are numbered since power-up,
//! with the unit's time. Hosts ask for them a few times a second, so that the serial line cannot lose one.

use crate::codec::{DecodeError, Put, Take};
use crate::records::Records;
use crate::{EDGE_HISTORY, EDGES_KEPT, HEARTBEAT_NS, INPUTS, MAX_EDGES};

/// An input line and the direction of its edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Slope {
    line: u8,
    /// Whether the level went from low to high.
    pub rising: bool,
}

impl Slope {
    /// `None` if the unit has no such line.
    pub fn new(line: u8, rising: bool) -> Option<Self> {
        (usize::from(line) < INPUTS).then_some(Self { line, rising })
    }

    /// The number of the input line, below [`INPUTS`].
    pub fn line(self) -> u8 {
        self.line
    }

    pub(crate) fn put(self, put: &mut Put<'_>) {
        put.u8(self.line);
        put.u8(u8::from(self.rising));
    }

    pub(crate) fn take(take: &mut Take<'_>) -> Result<Self, DecodeError> {
        let (line, rising) = (take.u8()?, take.u8()?);
        let rising = match rising {
            0 => false,
            1 => true,
            _ => return Err(DecodeError::Value),
        };
        Self::new(line, rising).ok_or(DecodeError::Value)
    }
}

/// One edge as it happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Edge {
    /// Consecutive since power-up, over all lines.
    pub number: u64,
    /// When it came, unit's clock, ns.
    pub time_ns: u64,
    /// Which line, and which way.
    pub slope: Slope,
    /// Edges of any line since the one before this that were too many to be kept.
    pub skipped: u16,
}

impl Edge {
    const NONE: Self = Self { number: 0, time_ns: 0, slope: Slope { line: 0, rising: false }, skipped: 0 };

    pub(crate) fn put(&self, put: &mut Put<'_>) {
        put.u64(self.number);
        put.u64(self.time_ns);
        self.slope.put(put);
        put.u16(self.skipped);
    }

    pub(crate) fn take(take: &mut Take<'_>) -> Result<Self, DecodeError> {
        Ok(Self {
            number: take.u64()?,
            time_ns: take.u64()?,
            slope: Slope::take(take)?,
            skipped: take.u16()?,
        })
    }
}

/// Edges with consecutive numbers, as one message carries them.
pub type Edges = Records<Edge>;

/// What the unit knows of its inputs.
#[derive(Debug, Clone)]
pub(crate) struct Inputs {
    kept: [Edge; EDGE_HISTORY],
    next: u64,
    levels: u8,
    /// Since the last edge that was kept.
    skipped: u16,
    /// How many edges were kept since `window_ns`.
    in_window: u8,
    window_ns: u64,
}

impl Inputs {
    pub(crate) const fn new() -> Self {
        Self { kept: [Edge::NONE; EDGE_HISTORY], next: 0, levels: 0, skipped: 0, in_window: 0, window_ns: 0 }
    }

    /// Number of the next edge.
    pub(crate) fn next(&self) -> u64 {
        self.next
    }

    /// A bit a line, as its last edge left it.
    pub(crate) fn levels(&self) -> u8 {
        self.levels
    }

    /// An edge came. One too many is not kept and counts as skipped: a line that swings fast must not take the room of the
    /// triggers on the serial line.
    pub(crate) fn take(&mut self, slope: Slope, time_ns: u64) {
        let bit = 1 << slope.line;
        self.levels = if slope.rising { self.levels | bit } else { self.levels & !bit };
        if time_ns.saturating_sub(self.window_ns) >= HEARTBEAT_NS {
            (self.window_ns, self.in_window) = (time_ns, 0);
        }
        if self.in_window >= EDGES_KEPT {
            self.skipped = self.skipped.saturating_add(1);
            return;
        }
        self.in_window += 1;
        let skipped = core::mem::take(&mut self.skipped);
        self.kept[(self.next % EDGE_HISTORY as u64) as usize] =
            Edge { number: self.next, time_ns, slope, skipped };
        self.next = self.next.saturating_add(1);
    }

    /// What is left of the edges from `first` on, as many as one answer takes.
    pub(crate) fn query(&self, first: u64) -> impl Iterator<Item = Edge> + '_ {
        let oldest = self.next.saturating_sub(EDGE_HISTORY as u64);
        let kept =
            (first.max(oldest)..self.next).map(|number| self.kept[(number % EDGE_HISTORY as u64) as usize]);
        kept.take(MAX_EDGES)
    }
}
