// SPDX-License-Identifier: MIT OR Apache-2.0
//! Why the unit did not carry a request out: a code and two numbers on the wire, words for people here.

use crate::codec::{DecodeError, Put, Take};
use crate::timing::TimingError;
use crate::{MAX_WARM_UP, State};
use core::fmt;

/// A refusal. Layout, the same in all versions: code (u8), two values (u64 each) whose meaning the code gives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// No version in common; the unit's range.
    Version {
        /// Oldest version that the unit speaks.
        min: u8,
        /// Newest version that the unit speaks.
        current: u8,
    },
    /// The conversation has not begun: the unit restarted, or this is the first request.
    HelloFirst,
    /// The unit does not know this kind of request.
    UnknownRequest {
        /// The message kind that the unit does not know.
        kind: u8,
    },
    /// The request has the wrong length, or a code out of its range.
    Malformed,
    /// The timing cannot be run.
    Timing(TimingError),
    /// No timing was configured since the unit started.
    NotConfigured,
    /// Not possible while a link is armed or a train runs.
    Busy(State),
    /// The unit's timing is not the one that the host means.
    TimingDiffers {
        /// Digest of the unit's timing.
        unit: u32,
        /// Digest that the host gave.
        host: u32,
    },
    /// Another session is armed or runs; the first eight bytes of each id, little-endian.
    SessionDiffers {
        /// The session that the unit is in.
        unit: u64,
        /// The session that the request names.
        host: u64,
    },
    /// The other link armed the same session with other parameters.
    ArmDiffers {
        /// Trigger count of the other link.
        unit: u64,
        /// Trigger count of the request.
        host: u64,
    },
    /// The link's own node is not among those expected.
    RoleNotExpected,
    /// This session has already fired triggers: a session's triggers are fired once.
    SessionSpent {
        /// Triggers fired so far, without those of the warm-up.
        emitted: u64,
    },
    /// Start without all expected links armed.
    NotAllArmed {
        /// Bit 0: link A, bit 1: link B.
        armed_links: u8,
        /// How many nodes are expected.
        expected: u8,
    },
    /// A request to stop while no train runs.
    NotRunning(State),
    /// More warm-up triggers than the unit fires.
    WarmUpTooLong {
        /// The value that was requested.
        found: u32,
    },
    /// The session id is empty.
    SessionMissing,
    /// The other link's host has named another input for time code.
    TimeCodeDiffers {
        /// The input of the other link.
        unit: u8,
        /// The input of the request.
        host: u8,
    },
    /// An input cannot carry time code and start a train.
    InputIsTimeCode {
        /// The number of the input line.
        input: u8,
    },
    /// A code that this host's version does not have.
    Other {
        /// The refusal code that this version does not know.
        code: u8,
    },
}

impl Refusal {
    pub(crate) fn put(&self, put: &mut Put<'_>) {
        let timing = |error: TimingError| match error {
            TimingError::Period => (0, 0),
            TimingError::HeadCount => (1, 0),
            TimingError::Head(head) => (2, u64::from(head)),
            TimingError::HostSilence => (3, 0),
        };
        let (code, (a, b)) = match *self {
            Self::Version { min, current } => (0, (min.into(), current.into())),
            Self::HelloFirst => (1, (0, 0)),
            Self::UnknownRequest { kind } => (2, (kind.into(), 0)),
            Self::Malformed => (3, (0, 0)),
            Self::Timing(error) => (4, timing(error)),
            Self::NotConfigured => (5, (0, 0)),
            Self::Busy(state) => (6, (state as u64, 0)),
            Self::TimingDiffers { unit, host } => (7, (unit.into(), host.into())),
            Self::SessionDiffers { unit, host } => (8, (unit, host)),
            Self::ArmDiffers { unit, host } => (9, (unit, host)),
            Self::RoleNotExpected => (10, (0, 0)),
            Self::SessionSpent { emitted } => (11, (emitted, 0)),
            Self::NotAllArmed { armed_links, expected } => (12, (armed_links.into(), expected.into())),
            Self::NotRunning(state) => (13, (state as u64, 0)),
            Self::WarmUpTooLong { found } => (14, (found.into(), 0)),
            Self::SessionMissing => (15, (0, 0)),
            Self::TimeCodeDiffers { unit, host } => (16, (unit.into(), host.into())),
            Self::InputIsTimeCode { input } => (17, (input.into(), 0)),
            Self::Other { code } => (code, (0, 0)),
        };
        put.u8(code);
        put.u64(a);
        put.u64(b);
    }

    pub(crate) fn take(take: &mut Take<'_>) -> Result<Self, DecodeError> {
        let (code, a, b) = (take.u8()?, take.u64()?, take.u64()?);
        let byte = |value: u64| u8::try_from(value).map_err(|_| DecodeError::Value);
        let word = |value: u64| u32::try_from(value).map_err(|_| DecodeError::Value);
        let state = |value: u64| byte(value).and_then(|v| State::from_code(v).ok_or(DecodeError::Value));
        Ok(match code {
            0 => Self::Version { min: byte(a)?, current: byte(b)? },
            1 => Self::HelloFirst,
            2 => Self::UnknownRequest { kind: byte(a)? },
            3 => Self::Malformed,
            4 => Self::Timing(match a {
                0 => TimingError::Period,
                1 => TimingError::HeadCount,
                2 => TimingError::Head(byte(b)?),
                3 => TimingError::HostSilence,
                _ => return Ok(Self::Other { code }),
            }),
            5 => Self::NotConfigured,
            6 => Self::Busy(state(a)?),
            7 => Self::TimingDiffers { unit: word(a)?, host: word(b)? },
            8 => Self::SessionDiffers { unit: a, host: b },
            9 => Self::ArmDiffers { unit: a, host: b },
            10 => Self::RoleNotExpected,
            11 => Self::SessionSpent { emitted: a },
            12 => Self::NotAllArmed { armed_links: byte(a)?, expected: byte(b)? },
            13 => Self::NotRunning(state(a)?),
            14 => Self::WarmUpTooLong { found: word(a)? },
            15 => Self::SessionMissing,
            16 => Self::TimeCodeDiffers { unit: byte(a)?, host: byte(b)? },
            17 => Self::InputIsTimeCode { input: byte(a)? },
            // Codes are append-only, so one from a newer unit is still a refusal.
            _ => Self::Other { code },
        })
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Version { min, current } => {
                write!(f, "the unit speaks protocol versions {min} to {current}")
            }
            Self::HelloFirst => f.write_str("the unit knows no host on this link: it was restarted"),
            Self::UnknownRequest { kind } => write!(f, "the unit does not know request kind {kind}"),
            Self::Malformed => f.write_str("the unit could not read the request"),
            Self::Timing(error) => write!(f, "the timing cannot be run: {error}"),
            Self::NotConfigured => f.write_str("no timing is configured"),
            Self::Busy(state) => write!(f, "the unit is {state}"),
            Self::TimingDiffers { unit, host } => write!(
                f,
                "the timing in force (digest {unit:08x}) is not this host's ({host:08x}): do all nodes have the same rig file?"
            ),
            Self::SessionDiffers { unit, host } => {
                write!(f, "the unit is at session {unit:016x}, expected {host:016x}")
            }
            Self::ArmDiffers { unit, host } => write!(
                f,
                "the other link armed this session with other parameters ({unit} triggers there, {host} here)"
            ),
            Self::RoleNotExpected => f.write_str("this link's node is not among those expected"),
            Self::SessionSpent { emitted } => {
                write!(f, "this session has already fired {emitted} triggers; a session runs once")
            }
            Self::NotAllArmed { armed_links, expected } => write!(
                f,
                "{} of {expected} expected links are armed (mask {armed_links:#04b})",
                armed_links.count_ones()
            ),
            Self::NotRunning(state) => write!(f, "no train runs: the unit is {state}"),
            Self::WarmUpTooLong { found } => {
                write!(f, "{found} warm-up triggers asked for, expected at most {MAX_WARM_UP}")
            }
            Self::SessionMissing => f.write_str("the session id is empty"),
            Self::TimeCodeDiffers { unit, host } => write!(
                f,
                "the other node has input {unit} for time code, this one input {host}: give both node files the same"
            ),
            Self::InputIsTimeCode { input } => {
                write!(f, "input {input} carries time code, and cannot start a session as well")
            }
            Self::Other { code } => write!(f, "reason code {code}, which this host does not know"),
        }
    }
}

#[cfg(feature = "std")]
impl std::error::Error for Refusal {}
