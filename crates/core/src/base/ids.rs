// SPDX-License-Identifier: MIT OR Apache-2.0
//! Identifiers that must not be mixed up, and what names and texts may hold: the one place for these rules.
//!
//! Names become names of files and topics, words of commands and lines on a terminal, whoever made them up. So what a
//! name may not be is refused wherever one is read: a configuration, a request, a recording, a calibration.

use serde::{Deserialize, Deserializer, Serialize};
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
        #[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
        #[serde(transparent)]
        pub struct $name(pub String);

        impl<'de> Deserialize<'de> for $name {
            fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
                let text = String::deserialize(from)?;
                check_name(&text).map_err(serde::de::Error::custom)?;
                Ok(Self(text))
            }
        }

        impl $name {
            /// The name as it is written in files.
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

/// The most characters of a name.
pub const NAME_MAX: usize = 64;
/// The most characters of a subject or a note.
pub const TEXT_MAX: usize = 4000;

/// Whether a name is allowed: 1 to 64 letters, digits, `.`, `_`, `-` and spaces, of which `.`, `-` and a space may
/// not be first.
///
/// # Errors
/// What was found, and what is allowed.
pub fn check_name(text: &str) -> Result<(), String> {
    let allowed = |c: char| c.is_alphanumeric() || matches!(c, '.' | '_' | '-' | ' ');
    let first = |c: char| c.is_alphanumeric() || c == '_';
    let count = text.chars().count();
    if !(1..=NAME_MAX).contains(&count) || !text.starts_with(first) || !text.chars().all(allowed) {
        let shown: String = text.chars().take(NAME_MAX).collect();
        return Err(format!(
            "the name {shown:?} has {count} characters; expected 1 to {NAME_MAX} letters, digits, '.', '_' and '-', \
             a letter, a digit or '_' first"
        ));
    }
    Ok(())
}

/// Whether a subject or a note is allowed: any text that can be printed on one line.
///
/// # Errors
/// What was found, and what is allowed.
pub fn check_text(what: &str, text: &str) -> Result<(), String> {
    let count = text.chars().count();
    if count > TEXT_MAX {
        return Err(format!("{what}: found {count} characters, expected at most {TEXT_MAX}"));
    }
    match text.chars().find(|c| is_control(*c)) {
        Some(found) => {
            Err(format!("{what}: found the control character {found:?}, expected one line of text"))
        }
        None => Ok(()),
    }
}

/// A text as it may be shown: each control character is replaced.
pub fn printable(text: &str) -> String {
    text.chars().map(|c| if is_control(c) { char::REPLACEMENT_CHARACTER } else { c }).collect()
}

/// A text of another program as one line of a list or a table: its lines one behind the other, without characters
/// that control a terminal.
pub fn one_line(text: impl fmt::Display) -> String {
    let lines = text.to_string();
    lines.lines().map(|line| printable(line.trim_end())).collect::<Vec<_>>().join("; ")
}

/// Whether a character moves a cursor, colours a terminal, ends a line, or changes the direction of writing.
pub(super) fn is_control(c: char) -> bool {
    let turns =
        matches!(c, '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}' | '\u{200e}' | '\u{200f}' | '\u{61c}');
    c.is_control() || turns
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
    /// A session's name: also its directory, so `[A-Za-z0-9._-]`, 1 to 64 characters, no leading dot or dash.
    SessionName
}

impl SessionName {
    /// Accepts a name that is safe as a directory; the error states why it is not.
    pub fn parse(text: &str) -> Result<Self, String> {
        let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
        if text.is_empty() || text.len() > 64 {
            return Err(format!("session name has {} characters, expected 1 to 64", text.len()));
        }
        if text.starts_with(['.', '-']) || !text.chars().all(allowed) {
            return Err(format!(
                "session name {text:?} may hold only letters, digits, '.', '_' and '-', and may not start \
                 with '.' or '-'"
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
    use super::{CameraId, SessionName, check_name, check_text, one_line, printable};
    use proptest::prelude::{prop_assert, proptest};

    #[test]
    fn names_lead_nowhere_and_print_as_they_are() {
        for good in ["h0_up", "_a", "Kamera 1", "obere-Kamera.2", "тест"] {
            assert_eq!(check_name(good), Ok(()));
        }
        let long = "x".repeat(65);
        for bad in [
            "",
            "../x",
            "/x",
            "a/b",
            "a\\b",
            "-rf",
            ".",
            " a",
            "a\nb",
            "a\u{1b}[2J",
            "a\u{202e}b",
            "a\"b",
            "a$b",
            &long,
        ] {
            assert!(check_name(bad).is_err(), "{bad:?}");
            let json = serde_json::to_string(bad).expect("JSON");
            let refused = serde_json::from_str::<CameraId>(&json).expect_err("refused").to_string();
            assert!(!refused.contains(['\n', '\u{1b}', '\u{202e}']), "{refused:?}");
        }
        assert!(check_text("note", "arm up, 2 kg (left)").is_ok());
        assert!(check_text("note", "a\u{1b}[31m").is_err() && check_text("note", &"x".repeat(5000)).is_err());
    }

    proptest! {
        #[test]
        fn what_is_shown_is_one_line(text in "\\PC*[\\x00-\\x1f\\x7f]{0,3}\\PC*") {
            for shown in [printable(&text), one_line(&text)] {
                prop_assert!(check_text("note", &shown).is_ok() || shown.chars().count() > super::TEXT_MAX);
            }
        }
    }

    #[test]
    fn a_text_of_several_lines_is_shown_as_one() {
        assert_eq!(one_line("killed\n  VERIFIED \r\n\u{1b}[2Jx"), "killed;   VERIFIED; \u{fffd}[2Jx");
    }

    #[test]
    fn session_names_cannot_leave_their_directory() {
        for bad in ["", "..", ".hidden", "a/b", "a\\b", "a b", "ä", "-rf", &"x".repeat(65)] {
            assert!(SessionName::parse(bad).is_err(), "{bad:?} must be refused");
        }
        for good in ["walk-01", "2026-11-21_a.b"] {
            assert_eq!(SessionName::parse(good).expect("a plain name").as_str(), good);
        }
    }
}
