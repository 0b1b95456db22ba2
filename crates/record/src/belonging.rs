// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which session a record is of: a mark in every one, so that a block of the disk which still holds an earlier session
//! is never taken for this one, whole as it may be.

use super::layout::{Entries, KEY_SESSION, RecordingHeader};
use serde::Deserialize;
use sha2::{Digest, Sha256};
use std::fmt;

/// The first version of the format whose records carry the mark.
const FIRST_VERSION: u32 = 2;

/// Marks the records of a session: the first 64 bits of the SHA-256 of its id.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SessionMark(pub u64);

impl SessionMark {
    /// The mark of a session's id; none for an empty id, which is not known.
    pub fn of(session_id: &str) -> Option<Self> {
        let digest = Sha256::digest(session_id.as_bytes());
        let first = digest.first_chunk().filter(|_| !session_id.is_empty())?;
        Some(Self(u64::from_be_bytes(*first)))
    }
}

impl fmt::Display for SessionMark {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:016x}", self.0)
    }
}

/// The fields of a small record that show where it belongs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Label {
    pub session: Option<SessionMark>,
    /// Its number among the small records of the recording, from 0.
    pub number: Option<u64>,
}

#[derive(Deserialize)]
struct Fields<'a> {
    #[serde(borrow)]
    session: Option<&'a str>,
    n: Option<u64>,
}

impl Label {
    /// Reads the fields from a small record's JSON.
    pub fn of(json: &[u8]) -> Self {
        let Ok(fields) = serde_json::from_slice::<Fields<'_>>(json) else { return Self::default() };
        Self { session: fields.session.and_then(parse), number: fields.n }
    }

    /// The mark in the entries of a metadata record.
    pub fn of_entries(entries: &Entries) -> Self {
        Self { session: entries.get(KEY_SESSION).and_then(|text| parse(text)), number: None }
    }

    /// Adds itself to a record, which is a JSON object.
    pub fn attach(self, json: &mut Vec<u8>) {
        if json.pop() == Some(b'}') {
            if let Some(session) = self.session {
                json.extend_from_slice(format!(",\"session\":\"{session}\"").as_bytes());
            }
            if let Some(number) = self.number {
                json.extend_from_slice(format!(",\"n\":{number}").as_bytes());
            }
            json.push(b'}');
        }
    }
}

fn parse(text: &str) -> Option<SessionMark> {
    u64::from_str_radix(text, 16).ok().filter(|_| text.len() == 16).map(SessionMark)
}

/// The mark that the records of a recording must have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Belonging {
    /// Their mark; `None` where the session's id is not known: then nothing is checked.
    pub own: Option<SessionMark>,
    /// Version of the recording's format.
    pub version: u32,
}

impl Belonging {
    pub fn of(header: &RecordingHeader, version: u32) -> Self {
        Self { own: SessionMark::of(&header.session_id), version }
    }

    /// The mark that a recording of this version writes.
    pub fn written(&self) -> Option<SessionMark> {
        self.own.filter(|_| self.version >= FIRST_VERSION)
    }

    /// Whether a record with this mark is of the recording's session. One without a mark is taken in a recording of the
    /// version that had none.
    pub fn admits(&self, found: Option<SessionMark>) -> bool {
        match (self.own, found) {
            (None, _) => true,
            (Some(own), Some(found)) => own == found,
            (Some(_), None) => self.version < FIRST_VERSION,
        }
    }

    /// As [`Self::admits`], with an error that names both marks.
    pub fn check(&self, found: Option<SessionMark>) -> Result<(), String> {
        let shown = |mark: Option<SessionMark>| mark.map_or("none".to_owned(), |mark| mark.to_string());
        if self.admits(found) {
            return Ok(());
        }
        Err(format!(
            "a record of another session: its mark is {}, expected {}; the disk still held it",
            shown(found),
            shown(self.own)
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::{Belonging, Label, SessionMark};

    #[test]
    fn golden_marks() {
        let mark = SessionMark::of("abc").expect("an id");
        assert_eq!(mark.to_string(), "ba7816bf8f01cfea");
        assert_eq!(SessionMark::of(""), None);
        let mut json = br#"{"trigger":3}"#.to_vec();
        let label = Label { session: Some(mark), number: Some(41) };
        label.attach(&mut json);
        assert_eq!(json, br#"{"trigger":3,"session":"ba7816bf8f01cfea","n":41}"#);
        assert_eq!(Label::of(&json), label);
    }

    #[test]
    fn a_mark_is_needed_from_the_version_that_has_it() {
        let (own, other) = (SessionMark::of("a"), SessionMark::of("b"));
        for (version, without) in [(1, true), (2, false)] {
            let belonging = Belonging { own, version };
            assert!(belonging.admits(own) && !belonging.admits(other));
            assert_eq!(belonging.admits(None), without);
        }
        assert!(Belonging { own: None, version: 2 }.admits(other), "an id that is not known proves nothing");
    }
}
