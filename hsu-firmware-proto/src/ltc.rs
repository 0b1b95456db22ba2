// SPDX-License-Identifier: MIT OR Apache-2.0
//! Linear time code (SMPTE 12M), decoded from the edges of an input line.
//!
//! Each of a frame's 80 bits is a cell that begins with an edge; a one has another edge in its middle. The last 16 bits
//! are the sync word. Polarity has no meaning. At 24 to 30 frames a second a cell lasts 417 to 521 us.
//!
//! A code is given for 80 good cells between two sync words, and for nothing else. So the first frame after a silence or
//! a fault only teaches where the next one begins. Code that runs backwards has its sync word reversed and gives nothing.

use crate::time_code::{TimeCode, TimeCodeFrame};

/// Bits of one linear time code frame (SMPTE 12M).
const BITS: u8 = 80;
/// The last 16 bits of a frame, first bit lowest: in order of time 0011 1111 1111 1101.
const SYNC: u128 = 0b1011_1111_1111_1100;
/// A frame at a little more than 31 frames a second, ns.
const SHORTEST_FRAME_NS: u64 = 32_000_000;
/// A frame at a little less than 23 frames a second, ns.
const LONGEST_FRAME_NS: u64 = 43_700_000;
/// Between half a cell at 23 frames a second (272 us) and a whole one at 31 (403 us).
const HALF_OR_WHOLE_NS: u64 = 337_000;
/// As far from them on the other sides as that lies between them.
const SHORTEST_HALF_NS: u64 = 136_000;
const LONGEST_CELL_NS: u64 = 609_000;

/// The decoder of one line. It takes any edges at any times.
#[derive(Debug, Clone)]
pub struct Ltc {
    /// The last edge: its time and whether it rose.
    last: Option<(u64, bool)>,
    /// How long the first half of a one lasted.
    half_ns: Option<u64>,
    /// The last 80 bits, the oldest lowest.
    bits: u128,
    /// The frame that is being heard.
    frame: Option<Heard>,
    refused: u32,
}

/// A frame from its first edge on.
#[derive(Debug, Clone, Copy)]
struct Heard {
    begin_ns: u64,
    bits: u8,
    shortest_ns: u64,
    longest_ns: u64,
}

impl Ltc {
    /// A line on which nothing was heard.
    pub const fn new() -> Self {
        Self { last: None, half_ns: None, bits: 0, frame: None, refused: 0 }
    }

    /// Frames that began behind a sync word and were no good: broken off, a cell of the wrong length, a digit that does not
    /// exist.
    pub const fn refused(&self) -> u32 {
        self.refused
    }

    /// Forgets what is being heard: another line follows.
    pub fn silence(&mut self) {
        *self = Self { refused: self.refused, ..Self::new() };
    }

    /// An edge came: whether it rose, and the clock's time. The frame that it ends, if all of it was good.
    pub fn edge(&mut self, rising: bool, time_ns: u64) -> Option<TimeCodeFrame> {
        let (before_ns, rose) = self.last.replace((time_ns, rising))?;
        let apart_ns = time_ns.checked_sub(before_ns).unwrap_or(u64::MAX);
        // Two edges in the same direction: one between them was not seen.
        if rising == rose || !(SHORTEST_HALF_NS..=LONGEST_CELL_NS).contains(&apart_ns) {
            self.lose();
            return None;
        }
        let half_ns = self.half_ns.take();
        if apart_ns > HALF_OR_WHOLE_NS {
            if half_ns.is_some() {
                // Half a one and then a whole cell: halves were paired wrongly. A whole cell says where cells begin.
                self.lose();
            }
            return self.bit(false, apart_ns, time_ns);
        }
        match half_ns {
            Some(half_ns) => self.bit(true, half_ns + apart_ns, time_ns),
            None => {
                self.half_ns = Some(apart_ns);
                None
            }
        }
    }

    fn lose(&mut self) {
        self.half_ns = None;
        self.bits = 0;
        if self.frame.take().is_some() {
            self.refused = self.refused.saturating_add(1);
        }
    }

    /// Takes one bit, when its cell has ended.
    fn bit(&mut self, one: bool, cell_ns: u64, end_ns: u64) -> Option<TimeCodeFrame> {
        self.bits = self.bits >> 1 | u128::from(one) << (BITS - 1);
        let is_sync = self.bits >> (BITS - 16) == SYNC;
        if let Some(frame) = &mut self.frame {
            frame.bits += 1;
            frame.shortest_ns = frame.shortest_ns.min(cell_ns);
            frame.longest_ns = frame.longest_ns.max(cell_ns);
            if !is_sync && frame.bits < BITS {
                return None;
            }
        }
        let ended = self.frame.take();
        if is_sync {
            self.frame = Some(Heard { begin_ns: end_ns, bits: 0, shortest_ns: u64::MAX, longest_ns: 0 });
        }
        let ended = ended?;
        let good = (is_sync && ended.bits == BITS).then(|| ended.code(self.bits, end_ns)).flatten();
        if good.is_none() {
            self.refused = self.refused.saturating_add(1);
        }
        good
    }
}

impl Default for Ltc {
    fn default() -> Self {
        Self::new()
    }
}

impl Heard {
    /// The frame, if its cells are equally long and its digits exist.
    fn code(&self, bits: u128, end_ns: u64) -> Option<TimeCodeFrame> {
        let duration_ns = end_ns.checked_sub(self.begin_ns)?;
        let in_range = (SHORTEST_FRAME_NS..=LONGEST_FRAME_NS).contains(&duration_ns);
        // Three tenths of a cell: more than a recorder's jitter, less than half a cell.
        let is_even = self.shortest_ns * u64::from(BITS) * 10 >= duration_ns * 7
            && self.longest_ns * u64::from(BITS) * 10 <= duration_ns * 13;
        if !in_range || !is_even {
            return None;
        }
        let field = |first: u8, count: u8| (bits >> first) as u8 & ((1 << count) - 1);
        let digits = |units: u8, tens: u8, count: u8| {
            let units = field(units, 4);
            (units < 10).then(|| field(tens, count) * 10 + units)
        };
        let drop_frame = field(10, 1) == 1;
        let (seconds, minutes) = (digits(16, 24, 3)?, digits(32, 40, 3)?);
        let code = TimeCode::new(digits(48, 56, 2)?, minutes, seconds, digits(0, 8, 2)?, drop_frame)?;
        Some(TimeCodeFrame { time_ns: self.begin_ns, duration_ns: u32::try_from(duration_ns).ok()?, code })
    }
}
