// SPDX-License-Identifier: MIT OR Apache-2.0
//! The sessions that a worker has done, as a node of its machine finds them in the results.

use super::state::{Job, Stage};
use crate::base::ids::SessionName;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Number of sessions that are listed: those whose jobs were written last.
const KNOWN_MAX: usize = 1000;

/// A session whose clouds are there.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Done {
    pub session: String,
    /// The id that its recordings share.
    pub session_id: String,
    /// The directory of its results.
    pub result: PathBuf,
    /// When it was done, host clock, ns: another time is another result.
    pub ended_ns: u64,
}

/// When a job was written, and its bytes.
type Stamp = (SystemTime, u64);

/// All of them, as last seen.
#[derive(Debug, Default)]
pub struct DoneSessions {
    /// By name; `None`: there is a job, and it is not done.
    known: BTreeMap<String, (Stamp, Option<Done>)>,
}

impl DoneSessions {
    /// What is there now. A job is read when it is new or has changed since `before`.
    pub fn look(results: &Path, before: &Self) -> Self {
        let entries = std::fs::read_dir(results).into_iter().flatten().flatten();
        let mut found: Vec<(Stamp, String)> = entries
            .filter_map(|entry| {
                let name = entry.file_name().into_string().ok()?;
                // A session's name is one component of a path: nothing else is looked up.
                SessionName::parse(&name).ok()?;
                let job = std::fs::metadata(Job::path(results, &name)).ok()?;
                Some(((job.modified().ok()?, job.len()), name))
            })
            .collect();
        found.sort_by(|a, b| b.cmp(a));
        found.truncate(KNOWN_MAX);
        let known = found.into_iter().map(|(stamp, name)| {
            let same = before.known.get(&name).filter(|(then, _)| *then == stamp);
            let done = same.map_or_else(|| read(results, &name), |(_, done)| done.clone());
            (name, (stamp, done))
        });
        Self { known: known.collect() }
    }

    /// The session of this name, if it is done.
    pub fn of(&self, session: &str) -> Option<&Done> {
        self.known.get(session)?.1.as_ref()
    }

    /// All sessions whose clouds are complete.
    pub fn all(&self) -> impl Iterator<Item = &Done> {
        self.known.values().filter_map(|(_, done)| done.as_ref())
    }
}

fn read(results: &Path, name: &str) -> Option<Done> {
    let job = Job::load(results, name).filter(|job| job.stage == Stage::Done)?;
    Some(Done {
        session: name.to_owned(),
        session_id: job.session_id,
        result: results.join(name),
        ended_ns: job.ended_ns,
    })
}

#[cfg(test)]
mod tests {
    use super::{DoneSessions, Job, Stage};

    #[test]
    fn what_is_done_is_found_and_what_is_made_anew_is_another() {
        let dir = tempfile::tempdir().expect("a directory");
        let keep = |session: &str, stage, ended_ns| {
            std::fs::create_dir_all(dir.path().join(session)).expect("made");
            let job = Job { session: session.to_owned(), stage, ended_ns, ..Job::default() };
            job.store(dir.path()).expect("written");
        };
        keep("walk", Stage::Done, 1);
        keep("run", Stage::Reconstructing, 0);
        keep("half", Stage::Done, 1);
        std::fs::write(dir.path().join("half/job.json"), "{\"stage\":").expect("written");
        std::fs::create_dir(dir.path().join(".worker")).expect("made");
        let seen = DoneSessions::look(dir.path(), &DoneSessions::default());
        assert_eq!(seen.all().map(|done| done.session.as_str()).collect::<Vec<_>>(), ["walk"]);
        assert!(seen.of("run").is_none() && seen.of("../walk").is_none() && seen.of("").is_none());
        keep("run", Stage::Done, 5);
        keep("walk", Stage::Done, 22);
        let seen = DoneSessions::look(dir.path(), &seen);
        let ended = |session| seen.of(session).map(|done| done.ended_ns);
        assert_eq!((ended("walk"), ended("run"), ended("half")), (Some(22), Some(5), None));
        std::fs::remove_dir_all(dir.path().join("walk")).expect("mine");
        assert!(DoneSessions::look(dir.path(), &seen).of("walk").is_none());
        assert_eq!(DoneSessions::look(&dir.path().join("away"), &seen).all().count(), 0);
    }
}
