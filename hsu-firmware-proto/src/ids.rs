// SPDX-License-Identifier: MIT OR Apache-2.0
//! Identifiers of links, nodes and sessions, as they are sent.

use core::fmt;

/// Which of the unit's two sockets a link is plugged into.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LinkId {
    /// The first serial socket of the unit.
    A,
    /// The second serial socket of the unit.
    B,
}

impl LinkId {
    /// Both links, A before B.
    pub const ALL: [Self; crate::LINKS] = [Self::A, Self::B];

    /// 0 or 1; also the bit in link masks.
    pub const fn index(self) -> usize {
        match self {
            Self::A => 0,
            Self::B => 1,
        }
    }

    /// The link of a wire index; `None` for other numbers.
    pub const fn from_index(index: u8) -> Option<Self> {
        match index {
            0 => Some(Self::A),
            1 => Some(Self::B),
            _ => None,
        }
    }

    /// The other link of the unit.
    pub const fn other(self) -> Self {
        match self {
            Self::A => Self::B,
            Self::B => Self::A,
        }
    }
}

impl fmt::Display for LinkId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::A => "A",
            Self::B => "B",
        })
    }
}

/// 16 bytes that name one session on every link; all zero means "no session".
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SessionId(pub [u8; 16]);

impl SessionId {
    /// No session; in [`crate::Request::Disarm`]: whichever it is.
    pub const NONE: Self = Self([0; 16]);
}

impl fmt::Display for SessionId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

/// A short name: UTF-8, zero-padded to 16 bytes. Empty means "nobody".
#[derive(Clone, Copy, PartialEq, Eq, Default)]
pub struct NodeName(pub [u8; 16]);

impl NodeName {
    /// The identifier that stands for no session.
    pub const NONE: Self = Self([0; 16]);

    /// From text; `None` if it has more than 16 bytes or holds a zero.
    pub fn new(text: &str) -> Option<Self> {
        let mut bytes = [0; 16];
        if text.as_bytes().contains(&0) {
            return None;
        }
        bytes.get_mut(..text.len())?.copy_from_slice(text.as_bytes());
        Some(Self(bytes))
    }

    /// Whether this is [`Self::NONE`], which identifies no session.
    pub fn is_none(&self) -> bool {
        self.0[0] == 0
    }

    /// As text; `"?"` where the other end sent something else.
    pub fn as_str(&self) -> &str {
        let length = self.0.iter().position(|&b| b == 0).unwrap_or(self.0.len());
        core::str::from_utf8(&self.0[..length]).unwrap_or("?")
    }
}

impl fmt::Debug for NodeName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", self.as_str())
    }
}

impl fmt::Display for NodeName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}
