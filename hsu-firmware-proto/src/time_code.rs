// SPDX-License-Identifier: MIT OR Apache-2.0
//! Time code of the laboratory (SMPTE 12M): what one code is, and those that the unit has heard on one of its inputs.
//! They are numbered since power-up. Hosts ask for them as they ask for edges.

use crate::codec::{DecodeError, Put, Take};
use crate::ltc::Ltc;
use crate::records::Records;
use crate::{INPUTS, TIME_CODE_HISTORY};
use core::fmt;

/// A time of day and the number of a frame in its second.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct TimeCode {
    hours: u8,
    minutes: u8,
    seconds: u8,
    frames: u8,
    drop_frame: bool,
}

impl TimeCode {
    /// `None` if there is no such code: 24 hours, 30 frames, and with `drop_frame` the two numbers that are left out at the
    /// begin of every minute but each tenth.
    pub const fn new(hours: u8, minutes: u8, seconds: u8, frames: u8, drop_frame: bool) -> Option<Self> {
        let in_range = hours < 24 && minutes < 60 && seconds < 60 && frames < 30;
        let left_out = drop_frame && !minutes.is_multiple_of(10) && seconds == 0 && frames < 2;
        if in_range && !left_out { Some(Self { hours, minutes, seconds, frames, drop_frame }) } else { None }
    }

    /// Hours of the code, 0 to 23.
    pub const fn hours(self) -> u8 {
        self.hours
    }

    /// Minutes of the code, 0 to 59.
    pub const fn minutes(self) -> u8 {
        self.minutes
    }

    /// Seconds of the code, 0 to 59.
    pub const fn seconds(self) -> u8 {
        self.seconds
    }

    /// Frame of the second, 0 to 29.
    pub const fn frames(self) -> u8 {
        self.frames
    }

    /// Frame numbers are left out, so that 29.97 frames a second keep up with the clock.
    pub const fn drop_frame(self) -> bool {
        self.drop_frame
    }

    /// Frames a second by which codes are counted; 23.976 counts as 24, 29.97 as 30.
    pub const RATES: [u8; 3] = [24, 25, 30];

    /// Parses `HH:MM:SS:FF`, or `HH:MM:SS;FF` for drop frame; `None` for anything else.
    pub fn parse(text: &str) -> Option<Self> {
        let text = text.as_bytes();
        let [_, _, b':', _, _, b':', _, _, mark @ (b':' | b';'), _, _] = text else { return None };
        let digit = |place: usize| text[place].is_ascii_digit().then(|| text[place] - b'0');
        let pair = |place: usize| Some(digit(place)? * 10 + digit(place + 1)?);
        Self::new(pair(0)?, pair(3)?, pair(6)?, pair(9)?, *mark == b';')
    }

    /// How many frames a day has, and how many have gone by; `None` if there is no such code at this rate.
    fn of_day(self, per_second: u8) -> Option<(u32, u32)> {
        let Self { hours, minutes, seconds, frames, drop_frame } = self;
        if frames >= per_second || drop_frame && per_second != 30 {
            return None;
        }
        let minute = u32::from(hours) * 60 + u32::from(minutes);
        let left_out = |minutes: u32| if drop_frame { 2 * (minutes - minutes / 10) } else { 0 };
        let rate = u32::from(per_second);
        let gone = (minute * 60 + u32::from(seconds)) * rate + u32::from(frames);
        Some((86_400 * rate - left_out(1440), gone - left_out(minute)))
    }

    /// How many frames after this code `later` is, midnight in between or not; `None` if one of them does not exist at this
    /// rate.
    pub fn until(self, later: Self, per_second: u8) -> Option<u32> {
        let ((day, from), (_, to)) = (self.of_day(per_second)?, later.of_day(per_second)?);
        (self.drop_frame == later.drop_frame).then_some((to + day - from) % day)
    }

    /// The code so many frames later; `None` if this one does not exist at this rate.
    pub fn after(self, frames: u32, per_second: u8) -> Option<Self> {
        let (day, from) = self.of_day(per_second)?;
        let mut at = (from + frames % day) % day;
        if self.drop_frame {
            // Ten minutes have 17982 frames; each of their minutes but the first has 1798.
            let (tens, rest) = (at / 17_982, at % 17_982);
            at += 18 * tens + rest.saturating_sub(2) / 1798 * 2;
        }
        let rate = u32::from(per_second);
        let second = at / rate;
        let part = |value: u32| value as u8;
        Self::new(
            part(second / 3600),
            part(second / 60 % 60),
            part(second % 60),
            part(at % rate),
            self.drop_frame,
        )
    }

    /// Whether `later` is the next frame's code at any of the [rates](Self::RATES).
    pub fn is_followed_by(self, later: Self) -> bool {
        Self::RATES.iter().any(|&per_second| self.until(later, per_second) == Some(1))
    }
}

/// As `HH:MM:SS:FF`, with drop frame `HH:MM:SS;FF`.
impl fmt::Display for TimeCode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { hours, minutes, seconds, frames, drop_frame } = self;
        let mark = if *drop_frame { ';' } else { ':' };
        write!(f, "{hours:02}:{minutes:02}:{seconds:02}{mark}{frames:02}")
    }
}

/// A code as it was heard.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TimeCodeFrame {
    /// The edge that its first bit begins with, unit's clock, ns.
    pub time_ns: u64,
    /// From there to the edge that the next frame begins with, ns.
    pub duration_ns: u32,
    /// The time code that the frame carries.
    pub code: TimeCode,
}

impl TimeCodeFrame {
    const NONE: Self = Self {
        time_ns: 0,
        duration_ns: 0,
        code: TimeCode { hours: 0, minutes: 0, seconds: 0, frames: 0, drop_frame: false },
    };

    pub(crate) fn put(&self, put: &mut Put<'_>) {
        put.u64(self.time_ns);
        put.u32(self.duration_ns);
        let TimeCode { hours, minutes, seconds, frames, drop_frame } = self.code;
        [hours, minutes, seconds, frames, u8::from(drop_frame)].iter().for_each(|&byte| put.u8(byte));
    }

    pub(crate) fn take(take: &mut Take<'_>) -> Result<Self, DecodeError> {
        let (time_ns, duration_ns) = (take.u64()?, take.u32()?);
        let [hours, minutes, seconds, frames, flags] = take.array()?;
        if flags > 1 {
            return Err(DecodeError::Value);
        }
        let code = TimeCode::new(hours, minutes, seconds, frames, flags == 1).ok_or(DecodeError::Value)?;
        Ok(Self { time_ns, duration_ns, code })
    }
}

/// Time codes with consecutive numbers, as one message carries them.
pub type TimeCodeFrames = Records<TimeCodeFrame>;

/// The byte that stands for no input.
const NO_INPUT: u8 = 0xff;

pub(crate) fn put_input(input: Option<u8>, put: &mut Put<'_>) {
    put.u8(input.unwrap_or(NO_INPUT));
}

pub(crate) fn take_input(take: &mut Take<'_>) -> Result<Option<u8>, DecodeError> {
    match take.u8()? {
        NO_INPUT => Ok(None),
        line if usize::from(line) < INPUTS => Ok(Some(line)),
        _ => Err(DecodeError::Value),
    }
}

/// What the unit knows of the time code.
#[derive(Debug, Clone)]
pub(crate) struct TimeCodes {
    input: Option<u8>,
    ltc: Ltc,
    kept: [TimeCodeFrame; TIME_CODE_HISTORY],
    next: u64,
}

impl TimeCodes {
    pub(crate) const fn new() -> Self {
        Self { input: None, ltc: Ltc::new(), kept: [TimeCodeFrame::NONE; TIME_CODE_HISTORY], next: 0 }
    }

    /// The input that is listened to.
    pub(crate) fn input(&self) -> Option<u8> {
        self.input
    }

    /// Listens to another input, or to none.
    pub(crate) fn listen(&mut self, input: Option<u8>) {
        if input != self.input {
            self.input = input;
            self.ltc.silence();
        }
    }

    /// Number of the next code.
    pub(crate) fn next(&self) -> u64 {
        self.next
    }

    /// Frames that were heard and were no good, since power-up.
    pub(crate) fn refused(&self) -> u32 {
        self.ltc.refused()
    }

    /// An edge of that input.
    pub(crate) fn take(&mut self, rising: bool, time_ns: u64) {
        if let Some(frame) = self.ltc.edge(rising, time_ns) {
            self.kept[(self.next % TIME_CODE_HISTORY as u64) as usize] = frame;
            self.next = self.next.saturating_add(1);
        }
    }

    /// Number of the first code that is left from `first` on, or of the next one; and the codes from there.
    pub(crate) fn query(&self, first: u64) -> (u64, TimeCodeFrames) {
        let oldest = self.next.saturating_sub(TIME_CODE_HISTORY as u64);
        let first = first.clamp(oldest, self.next);
        let mut codes = TimeCodeFrames::default();
        let mut kept =
            (first..self.next).map(|number| self.kept[(number % TIME_CODE_HISTORY as u64) as usize]);
        kept.all(|frame| codes.push(frame));
        (first, codes)
    }
}
