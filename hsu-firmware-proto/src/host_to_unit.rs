// SPDX-License-Identifier: MIT OR Apache-2.0
//! Messages from a host to the unit.
//!
//! Layout: version (u8), kind (u8), request id (u32), then the fields of the kind. The unit answers every
//! request exactly once per receipt: with an acknowledgement, the answer asked for, or a refusal. A request
//! that repeats the id of the link's previous one is not executed again; its answer is sent again.

use crate::codec::{DecodeError, Put, Take};
use crate::ids::{NodeName, SessionId};
use crate::inputs::Slope;
use crate::time_code::{put_input, take_input};
use crate::timing::{Timing, TimingError};
use crate::{LINKS, MAX_MESSAGE, version};

/// A request of a host.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HostToUnit {
    /// Chosen by the host, different from that of its previous request on this link.
    pub request_id: u32,
    /// What the host requests of the unit.
    pub request: Request,
}

/// Who is calling, and in which versions it can talk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Hello {
    /// Oldest version that the host speaks.
    pub min: u8,
    /// Newest version that the host speaks.
    pub current: u8,
    /// The node at this end of the link.
    pub role: NodeName,
}

/// What both links must agree on before a train can start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Arm {
    /// The session, the same on every link.
    pub session: SessionId,
    /// Triggers in the train, without the warm-up; 0: until [`Request::Stop`].
    pub trigger_count: u64,
    /// Triggers before the train, numbered `-warm_up..0`.
    pub warm_up: u32,
    /// [`Timing::digest`] of the timing that this host has configured.
    pub timing_digest: u32,
    /// The nodes that must arm, in the same order on every link; [`NodeName::NONE`] where fewer.
    pub expected: [NodeName; LINKS],
}

/// What a host can ask for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Request {
    /// Opens the conversation; must be the first. Withdraws what this link had armed, unless it runs.
    Hello(Hello),
    /// Sets the timing; echoed as [`crate::UnitToHost::Timing`]. Refused while a link is armed, unless it is the same.
    Configure(Result<Timing, TimingError>),
    /// Requests the timing that is in force.
    ReadTiming,
    /// Arms the link on which it arrives.
    Arm(Arm),
    /// Starts the train; refused unless every expected link has armed.
    Start(SessionId),
    /// Ends the train after the current trigger.
    Stop(SessionId),
    /// Ends the train now, or takes the arming of all links back. [`SessionId::NONE`]: whichever session it is.
    Disarm(SessionId),
    /// Asks for the unit's time at receipt.
    ReadClock {
        /// Any number; the answer returns it unchanged.
        token: u64,
    },
    /// Asks for triggers again, up to [`crate::MAX_RECORDS`] of them.
    QueryTriggers {
        /// The session that they belong to.
        session: SessionId,
        /// Number of the first; negative for warm-up.
        first: i64,
        /// How many records the unit should repeat.
        count: u16,
    },
    /// Requests the state of the unit.
    ReadStatus,
    /// Says that the host is alive.
    Heartbeat,
    /// Closes the conversation in good order. Withdraws what this link had armed, unless it runs.
    Goodbye,
    /// As [`Request::Start`], but the train starts at the next such edge of an input.
    StartAtEdge(SessionId, Slope),
    /// Asks for edges of the inputs again, up to [`crate::MAX_EDGES`] of them.
    QueryEdges {
        /// Number of the first record to repeat.
        first: u64,
    },
    /// Says which input carries linear time code. Until this link's Hello, Goodbye or another such request its edges are
    /// decoded and are none of [`Request::QueryEdges`]. Refused where the other link has named another input.
    SetTimeCode(Option<u8>),
    /// Asks for time codes again, up to [`crate::MAX_RECORDS`] of them.
    QueryTimeCodes {
        /// Number of the first record to repeat.
        first: u64,
    },
}

const HELLO: u8 = 0;
const CONFIGURE: u8 = 1;
const READ_TIMING: u8 = 2;
const ARM: u8 = 3;
const START: u8 = 4;
const STOP: u8 = 5;
const DISARM: u8 = 6;
const READ_CLOCK: u8 = 7;
const QUERY_TRIGGERS: u8 = 8;
const READ_STATUS: u8 = 9;
const HEARTBEAT: u8 = 10;
const GOODBYE: u8 = 11;
const START_AT_EDGE: u8 = 12;
const QUERY_EDGES: u8 = 13;
const SET_TIME_CODE: u8 = 14;
const QUERY_TIME_CODES: u8 = 15;

/// A message that the unit cannot read, with the request id where it got that far.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Unreadable {
    /// From the header, the same in all versions.
    pub request_id: Option<u32>,
    /// Why the message cannot be decoded.
    pub error: DecodeError,
}

impl HostToUnit {
    /// Writes the message; returns its length. A timing that cannot be run is not written and gives 0.
    pub fn encode(&self, out: &mut [u8; MAX_MESSAGE]) -> usize {
        let mut put = Put::new(out);
        put.u8(version::CURRENT);
        put.u8(self.request.kind());
        put.u32(self.request_id);
        match &self.request {
            Request::Hello(hello) => {
                put.u8(hello.min);
                put.u8(hello.current);
                put.bytes(&hello.role.0);
            }
            Request::Configure(Ok(timing)) => timing.put(&mut put),
            Request::Configure(Err(_)) => return 0,
            Request::Arm(arm) => {
                put.bytes(&arm.session.0);
                put.u64(arm.trigger_count);
                put.u32(arm.warm_up);
                put.u32(arm.timing_digest);
                arm.expected.iter().for_each(|name| put.bytes(&name.0));
            }
            Request::Start(session) | Request::Stop(session) | Request::Disarm(session) => {
                put.bytes(&session.0);
            }
            Request::ReadClock { token } => put.u64(*token),
            Request::QueryTriggers { session, first, count } => {
                put.bytes(&session.0);
                put.i64(*first);
                put.u16(*count);
            }
            Request::StartAtEdge(session, slope) => {
                put.bytes(&session.0);
                slope.put(&mut put);
            }
            Request::QueryEdges { first } | Request::QueryTimeCodes { first } => put.u64(*first),
            Request::SetTimeCode(input) => put_input(*input, &mut put),
            Request::ReadTiming | Request::ReadStatus | Request::Heartbeat | Request::Goodbye => {}
        }
        put.length()
    }

    /// Decodes one message from its bytes.
    pub fn decode(message: &[u8]) -> Result<Self, Unreadable> {
        let mut take = Take::new(message);
        let unreadable = |error| Unreadable { request_id: None, error };
        let found = take.u8().map_err(unreadable)?;
        let kind = take.u8().map_err(unreadable)?;
        let request_id = take.u32().map_err(unreadable)?;
        let unreadable = |error| Unreadable { request_id: Some(request_id), error };
        // A Hello is the same in all versions: it is what finds out about them.
        if kind != HELLO && !(version::MIN..=version::CURRENT).contains(&found) {
            return Err(unreadable(DecodeError::Version { found }));
        }
        let request = Request::take(kind, &mut take).map_err(unreadable)?;
        take.end().map_err(unreadable)?;
        Ok(Self { request_id, request })
    }
}

impl Request {
    fn kind(&self) -> u8 {
        match self {
            Self::Hello(_) => HELLO,
            Self::Configure(_) => CONFIGURE,
            Self::ReadTiming => READ_TIMING,
            Self::Arm(_) => ARM,
            Self::Start(_) => START,
            Self::Stop(_) => STOP,
            Self::Disarm(_) => DISARM,
            Self::ReadClock { .. } => READ_CLOCK,
            Self::QueryTriggers { .. } => QUERY_TRIGGERS,
            Self::ReadStatus => READ_STATUS,
            Self::Heartbeat => HEARTBEAT,
            Self::Goodbye => GOODBYE,
            Self::StartAtEdge(..) => START_AT_EDGE,
            Self::QueryEdges { .. } => QUERY_EDGES,
            Self::SetTimeCode(_) => SET_TIME_CODE,
            Self::QueryTimeCodes { .. } => QUERY_TIME_CODES,
        }
    }

    fn take(kind: u8, take: &mut Take<'_>) -> Result<Self, DecodeError> {
        Ok(match kind {
            HELLO => {
                Self::Hello(Hello { min: take.u8()?, current: take.u8()?, role: NodeName(take.array()?) })
            }
            CONFIGURE => Self::Configure(Timing::take(take)?),
            READ_TIMING => Self::ReadTiming,
            ARM => Self::Arm(Arm {
                session: SessionId(take.array()?),
                trigger_count: take.u64()?,
                warm_up: take.u32()?,
                timing_digest: take.u32()?,
                expected: [NodeName(take.array()?), NodeName(take.array()?)],
            }),
            START => Self::Start(SessionId(take.array()?)),
            STOP => Self::Stop(SessionId(take.array()?)),
            DISARM => Self::Disarm(SessionId(take.array()?)),
            READ_CLOCK => Self::ReadClock { token: take.u64()? },
            QUERY_TRIGGERS => Self::QueryTriggers {
                session: SessionId(take.array()?),
                first: take.i64()?,
                count: take.u16()?,
            },
            READ_STATUS => Self::ReadStatus,
            HEARTBEAT => Self::Heartbeat,
            GOODBYE => Self::Goodbye,
            START_AT_EDGE => Self::StartAtEdge(SessionId(take.array()?), Slope::take(take)?),
            QUERY_EDGES => Self::QueryEdges { first: take.u64()? },
            SET_TIME_CODE => Self::SetTimeCode(take_input(take)?),
            QUERY_TIME_CODES => Self::QueryTimeCodes { first: take.u64()? },
            found => return Err(DecodeError::Kind { found }),
        })
    }
}
