// SPDX-License-Identifier: MIT OR Apache-2.0
//! A recorder that plays linear time code (SMPTE 12M) into an input of the HSU, edge by edge.

use hsu_firmware_proto::{Slope, TimeCode};
use std::str::FromStr;

/// What is played, from the moment on in which it begins.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LtcSource {
    pub line: u8,
    /// The code of the first frame.
    pub first: TimeCode,
    /// Frames a second: 24 to 30, or 23.976 and the like.
    pub frames_per_second: f64,
}

/// Parses the text `LINE[:HH:MM:SS:FF[@FPS]]` of the option `--ltc`.
impl FromStr for LtcSource {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let expected =
            "expected an input, 0 to 7, a code and 23.5 to 30.5 frames a second, as in 3:10:00:00:00@25";
        let (line, code) = text.split_once(':').unwrap_or((text, "00:00:00:00"));
        let (code, rate) = code.split_once('@').unwrap_or((code, "25"));
        let source = Self {
            line: line.parse().map_err(|_| expected)?,
            first: TimeCode::parse(code).ok_or(expected)?,
            frames_per_second: rate.parse().map_err(|_| expected)?,
        };
        let in_range = source.line < 8 && (23.5..=30.5).contains(&source.frames_per_second);
        // A code of this rate.
        let exists = in_range && source.code(0).is_some();
        if exists { Ok(source) } else { Err(expected.to_owned()) }
    }
}

impl LtcSource {
    /// The code of a frame, from 0.
    fn code(&self, frame: u64) -> Option<TimeCode> {
        // More frames than a day has.
        let frame = u32::try_from(frame % 90_000_000).ok()?;
        self.first.after(frame, self.frames_per_second.round() as u8)
    }

    /// When a half of a bit begins, 160 a frame, ns after the first.
    fn half_ns(&self, half: u64) -> u64 {
        (half as f64 / 160.0 / self.frames_per_second * 1e9) as u64
    }
}

/// What was played from when to when, the HSU's clock.
#[derive(Debug, Clone, Copy)]
pub(super) struct Played {
    pub(super) source: LtcSource,
    pub(super) begin_ns: u64,
    /// `None`: it is still played.
    pub(super) end_ns: Option<u64>,
}

impl Played {
    /// The code at a time, and how much of its frame had gone by.
    pub(super) fn at(&self, time_ns: u64) -> Option<(TimeCode, f64)> {
        if self.end_ns.is_some_and(|end_ns| time_ns >= end_ns) {
            return None;
        }
        let place = time_ns.checked_sub(self.begin_ns)? as f64 * 1e-9 * self.source.frames_per_second;
        Some((self.source.code(place as u64)?, place.fract()))
    }
}

/// The edges, one after the other.
#[derive(Debug, Clone)]
pub(super) struct Player {
    source: LtcSource,
    begin_ns: u64,
    /// The half of a bit that the next edge begins.
    half: u64,
    rising: bool,
    /// Bits of the frame that is being played, the first one lowest.
    bits: u128,
}

impl Player {
    pub(super) fn new(source: LtcSource, begin_ns: u64) -> Self {
        let bits = source.code(0).map_or(0, frame);
        Self { source, begin_ns, half: 0, rising: true, bits }
    }

    /// The next edge, if it has come.
    pub(super) fn next(&mut self, now_ns: u64) -> Option<(Slope, u64)> {
        let time_ns = self.begin_ns + self.source.half_ns(self.half);
        if time_ns > now_ns {
            return None;
        }
        let slope = Slope::new(self.source.line, self.rising)?;
        self.rising = !self.rising;
        let place = self.half % 160;
        if place == 0 {
            self.bits = self.source.code(self.half / 160).map_or(0, frame);
        }
        // A bit begins with an edge; a one has another in its middle.
        let in_the_middle = place.is_multiple_of(2) && self.bits >> (place / 2) & 1 == 1;
        self.half += if in_the_middle || place % 2 == 1 { 1 } else { 2 };
        Some((slope, time_ns))
    }
}

/// A frame's 80 bits; user bits, colour frame and polarity are 0.
fn frame(code: TimeCode) -> u128 {
    let digits = |value: u8| (u128::from(value % 10), u128::from(value / 10));
    let mut bits = 0b1011_1111_1111_1100u128 << 64;
    for (value, place) in [(code.frames(), 0), (code.seconds(), 16), (code.minutes(), 32), (code.hours(), 48)]
    {
        let (units, tens) = digits(value);
        bits |= units << place | tens << (place + 8);
    }
    bits | u128::from(code.drop_frame()) << 10
}

#[cfg(test)]
mod tests {
    use super::{LtcSource, Player};
    use hsu_firmware_proto::Ltc;

    #[test]
    fn what_is_played_is_what_was_asked_for() {
        for (text, rate) in [
            ("3", 25.0),
            ("3:10:00:00:00", 25.0),
            ("0:23:59:58:10@23.976", 23.976),
            ("7:00:08:59;28@29.97", 29.97),
        ] {
            let source: LtcSource = text.parse().expect("a source");
            assert_eq!(source.frames_per_second, rate);
            let (mut player, mut ltc, mut frame) = (Player::new(source, 1000), Ltc::new(), 0u64);
            while let Some((slope, time_ns)) = player.next(10_000_000_000) {
                if let Some(found) = ltc.edge(slope.rising, time_ns) {
                    // The decoder learns from the first where the next one begins.
                    frame += 1;
                    assert_eq!(Some(found.code), source.code(frame));
                    assert_eq!(found.time_ns, 1000 + source.half_ns(frame * 160));
                }
            }
            assert_eq!((frame, ltc.refused()), ((10.0 * rate - 1e-5) as u64 - 1, 0), "{text}");
        }
        for text in ["8", "3:1", "3:10:00:00:25@25", "3:10:00:00:00@50", "3:10:00:00;00@25", "x:10:00:00:00"]
        {
            assert!(text.parse::<LtcSource>().is_err(), "{text}");
        }
    }
}
