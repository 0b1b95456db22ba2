//! Identifiers that must not be mixed up, and nothing else.

use serde::{Deserialize, Serialize};
use std::fmt;

/// 0-based index of a trigger within one session, counted by the HSU: the only time base both nodes share.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct TriggerIndex(pub u64);

/// GVSP block id as a camera sent it (16-bit ids wrap and skip 0; 64-bit ids do not wrap).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct BlockId(pub u64);

macro_rules! name_type {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(transparent)]
        pub struct $name(pub String);

        impl $name {
            /// The name as text.
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(&self.0)
            }
        }

        impl From<&str> for $name {
            fn from(text: &str) -> Self {
                Self(text.to_owned())
            }
        }
    };
}

name_type! {
    /// A camera's name in the rig, for instance `h0_up`.
    CameraId
}
name_type! {
    /// A head's name in the rig, for instance `h0`.
    HeadId
}
name_type! {
    /// An acquisition PC's name in the rig, for instance `a`.
    NodeId
}
name_type! {
    /// A session's name: also its directory, so `[A-Za-z0-9._-]`, 1 to 64 characters, no leading dot.
    SessionName
}

impl SessionName {
    /// Accepts a name that is safe as a directory, or says why it is not.
    pub fn parse(text: &str) -> Result<Self, String> {
        let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
        if text.is_empty() || text.len() > 64 {
            return Err(format!("session name has {} characters, expected 1 to 64", text.len()));
        }
        if text.starts_with('.') || !text.chars().all(allowed) {
            return Err(format!(
                "session name {text:?} may hold only letters, digits, '.', '_' and '-', and may not start with '.'"
            ));
        }
        Ok(Self(text.to_owned()))
    }
}

impl fmt::Display for TriggerIndex {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl fmt::Display for BlockId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

#[cfg(test)]
mod tests {
    use super::SessionName;

    #[test]
    fn session_names_cannot_leave_their_directory() {
        for bad in ["", "..", ".hidden", "a/b", "a\\b", "a b", "ä", &"x".repeat(65)] {
            assert!(SessionName::parse(bad).is_err(), "{bad:?} must be refused");
        }
        for good in ["walk-01", "2026-11-21_a.b"] {
            assert_eq!(SessionName::parse(good).expect("a plain name").as_str(), good);
        }
    }
}
