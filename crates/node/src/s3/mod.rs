// SPDX-License-Identifier: MIT OR Apache-2.0
//! Recordings and results in an S3-compatible object store, for machines that share no directory.
//!
//! `reconstruct` takes `s3://BUCKET/PREFIX` for the session and for `--out`. Recordings are read in many places and
//! results are renamed into place, neither of which a store offers; so both are staged in a scratch directory
//! ([`recordings`], [`results`]):
//!
//! ```text
//! s3://BUCKET/SESSION/node-X/segment-NNN.mcap  -->  SCRATCH/session/...   indexes, and the frames of the shard
//! s3://BUCKET/OUT/phases/CAMERA_INDEX.phase    <->  SCRATCH/out/...       finished files first, new ones go back
//! s3://BUCKET/OUT/summary.json                 <--                        last
//! ```
//!
//! Objects appear whole or not at all, so that the rules of a shared directory hold: a name means a whole file.

pub mod recordings;
pub mod remote;
pub mod results;

use std::fmt;
use std::path::Path;

/// The place of objects in a store: `s3://BUCKET/PREFIX`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Location {
    pub bucket: String,
    /// Begins all names, without a slash at either end; may be empty.
    pub prefix: String,
}

impl Location {
    /// `None` for what is a path on this machine.
    pub fn of(path: &Path) -> Option<Result<Self, String>> {
        let rest = path.to_str()?.strip_prefix("s3://")?;
        let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
        let prefix = prefix.trim_matches('/');
        let known = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || matches!(c, '.' | '-');
        let named = (3..=63).contains(&bucket.len()) && bucket.chars().all(known);
        let plain = prefix.is_empty() || prefix.split('/').all(|part| !matches!(part, "" | "." | ".."));
        Some(match named && plain {
            true => Ok(Self { bucket: bucket.to_owned(), prefix: prefix.to_owned() }),
            false => Err(format!(
                "{}: expected s3://BUCKET/PREFIX, a bucket of 3 to 63 lower-case letters, digits, dots and hyphens",
                path.display()
            )),
        })
    }

    /// The key of an object below the prefix.
    fn key(&self, name: &str) -> String {
        match self.prefix.is_empty() {
            true => name.to_owned(),
            false => format!("{}/{name}", self.prefix),
        }
    }
}

/// Number of requests that are under way at once, since each answer takes its time.
const REQUESTS: usize = 8;

/// Runs `work` on a rayon pool, so that its requests are sent side by side.
fn with_many_requests<T: Send>(work: impl FnOnce() -> Result<T, String> + Send) -> Result<T, String> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(REQUESTS).build();
    pool.map_err(|e| e.to_string())?.install(work)
}

impl fmt::Display for Location {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "s3://{}/{}", self.bucket, self.prefix)
    }
}

#[cfg(test)]
mod tests {
    use super::Location;
    use std::path::Path;

    #[test]
    fn locations_are_told_from_paths() {
        let of = |text: &str| Location::of(Path::new(text));
        assert_eq!(of("sessions/walk-01"), None);
        assert_eq!(of("/s3://x"), None);
        let found = of("s3://lab.day-1/sessions/walk-01/").expect("a location").expect("a good one");
        assert_eq!(
            (found.bucket.as_str(), found.key("a.ply").as_str()),
            ("lab.day-1", "sessions/walk-01/a.ply")
        );
        assert_eq!(found.to_string(), "s3://lab.day-1/sessions/walk-01");
        assert_eq!(of("s3://lab").expect("a location").expect("a good one").key("a"), "a");
        for bad in ["s3://", "s3://x/y", "s3://Lab/y", "s3://lab/a//b", "s3://lab/../b", "s3://a b c/d"] {
            assert!(of(bad).expect("a location").is_err(), "{bad}");
        }
    }
}
