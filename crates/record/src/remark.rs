// SPDX-License-Identifier: MIT OR Apache-2.0
//! The operator's rating and note of a recording, beside the recording and never in it.
//!
//! It lies in the session's directory as `remark-NODE.json`, so that a recording stays as its verdict describes it.

use crate::base::ids::{NodeId, check_text};
use crate::base::{json, regular, write_whole};
use serde::{Deserialize, Deserializer, Serialize};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// How good a take is for what it was taken for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Rating {
    /// The take is to be used.
    Good,
    /// The take has to be checked before it is used.
    Doubtful,
    /// The take is not to be used.
    Bad,
}

/// A rating and a note; both may be null, and neither is left out: what was kept gives way as a whole.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Remark {
    /// How good the take is; null where no rating was given.
    #[serde(deserialize_with = "present")]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub rating: Option<Rating>,
    /// Why, in one line of up to 4000 characters.
    #[serde(deserialize_with = "present")]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub note: Option<String>,
}

/// A value that is null or there: a field that is left out was not thought of.
fn present<'de, D: Deserializer<'de>, T: Deserialize<'de>>(from: D) -> Result<Option<T>, D::Error> {
    Option::deserialize(from)
}

/// A file that is longer was not written here.
const BYTES_MAX: u64 = 64 << 10;

fn file(session: &Path, node: &NodeId) -> PathBuf {
    session.join(format!("remark-{node}.json"))
}

impl Remark {
    /// Checks whether it may be stored.
    ///
    /// # Errors
    /// The note is too long, or is more than one line of printable text.
    pub fn check(&self) -> Result<(), String> {
        self.note.as_ref().map_or(Ok(()), |note| check_text("note", note))
    }

    /// Keeps it for a node's recording of the session in this directory; what was there is replaced as a whole.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn save(&self, session: &Path, node: &NodeId) -> io::Result<()> {
        let text = serde_json::to_vec(self)?;
        write_whole(&file(session, node), |file| file.write_all(&text))
    }

    /// The stored remark; `None` where there is none that can be read.
    pub fn load(session: &Path, node: &NodeId) -> Option<Self> {
        let text = regular::read(&file(session, node), BYTES_MAX).ok()?;
        json::from_slice(&text).ok().filter(|remark: &Self| remark.check().is_ok())
    }

    /// When it was last written.
    pub fn written(session: &Path, node: &NodeId) -> Option<SystemTime> {
        std::fs::metadata(file(session, node)).ok()?.modified().ok()
    }
}

#[cfg(test)]
mod tests {
    use super::{Rating, Remark, file};
    use crate::base::ids::NodeId;

    #[test]
    fn a_remark_reads_back_and_other_files_are_refused() {
        let dir = tempfile::tempdir().expect("a directory");
        let node = NodeId::from("a");
        assert_eq!(Remark::load(dir.path(), &node), None);
        let remark =
            Remark { rating: Some(Rating::Doubtful), note: Some("left arm hides the side".to_owned()) };
        remark.save(dir.path(), &node).expect("writable");
        assert_eq!(Remark::load(dir.path(), &node), Some(remark));
        assert!(Remark::written(dir.path(), &node).is_some());
        for wrong in
            ["", "{", r#"{"rating":"best"}"#, r#"{"note":"two\nlines"}"#, r#"{"more":1}"#, "[]", "{}", "null"]
        {
            std::fs::write(file(dir.path(), &node), wrong).expect("writable");
            assert_eq!(Remark::load(dir.path(), &node), None, "{wrong}");
        }
        let long = Remark { note: Some("x".repeat(4001)), rating: None };
        assert!(long.check().is_err());
    }
}
