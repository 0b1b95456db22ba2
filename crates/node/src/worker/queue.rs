// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which sessions are there, and which comes next.

use super::state::{Job, Stage};
use crate::base::ids::SessionName;
use crate::base::time::host_time_ns;
use crate::config::{Order, WorkerConfig};
use crate::record::catalogue::{self, CatalogueEntry};
use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::UNIX_EPOCH;

/// A session whose recordings can be worked on.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    pub name: String,
    /// The id that its recordings share.
    pub session_id: String,
    /// When it was begun, host clock, ns.
    pub created_ns: u64,
    pub triggers: u64,
    /// Frames of all nodes, as the verdicts count them.
    pub frames: u64,
    /// The recording of each node, in the configuration's order.
    pub parts: Vec<PathBuf>,
}

/// All recorded sessions, sorted by what is left to do for them.
#[derive(Debug, Default)]
pub struct Inventory {
    /// Sessions with something to do, in the order in which they come.
    pub ready: Vec<Found>,
    /// Sessions that cannot be worked on yet, each with the reason.
    pub not_yet: Vec<(String, String)>,
    /// How many of these wait only for their next attempt.
    pub retries: u64,
    pub done: u64,
    /// Sessions that were set aside, each with the reason.
    pub set_aside: Vec<(String, String)>,
}

/// Looks at all sessions; `first` names those that come before the others, in this order.
pub fn look(config: &WorkerConfig, first: &[String]) -> Inventory {
    let mut inventory = Inventory::default();
    for name in names(config) {
        match Job::load(&config.results, &name).filter(Job::has_ended) {
            Some(job) if job.stage == Stage::Done => match recorded_since(config, &job) {
                false => inventory.done += 1,
                true => inventory.not_yet.push((
                    name,
                    "its results are of an older session of this name; move them away".to_owned(),
                )),
            },
            Some(job) => inventory.set_aside.push((name, job.reason.unwrap_or_default())),
            None => match parts(config, &name) {
                Ok(found) => match later(config, &name) {
                    None => inventory.ready.push(found),
                    Some(reason) => {
                        inventory.retries += 1;
                        inventory.not_yet.push((name, reason));
                    }
                },
                Err(reason) => inventory.not_yet.push((name, reason)),
            },
        }
    }
    let place = |found: &Found| first.iter().position(|name| *name == found.name).unwrap_or(usize::MAX);
    inventory.ready.sort_by_key(|found| match config.order {
        Order::Newest => (place(found), u64::MAX - found.created_ns),
        Order::Oldest => (place(found), found.created_ns),
    });
    inventory
}

/// Why a session that could be worked on waits for its next attempt.
fn later(config: &WorkerConfig, name: &str) -> Option<String> {
    let job = Job::load(&config.results, name)?;
    let wait_s = job.not_before_ns.checked_sub(host_time_ns()).filter(|ns| *ns > 0)? / 1_000_000_000;
    Some(format!("tried again in {wait_s} s: {}", job.reason.unwrap_or_default()))
}

/// Whether there is a recording of another session under the name of one that is done. Only those that have changed
/// since are looked into.
fn recorded_since(config: &WorkerConfig, job: &Job) -> bool {
    config.nodes.iter().any(|node| {
        let part = crate::record::node_dir(&node.sessions_dir.join(&job.session), &node.name);
        let changed = std::fs::metadata(&part).and_then(|metadata| metadata.modified());
        let changed_ns = changed.ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
        changed_ns.is_some_and(|time| time.as_nanos() > u128::from(job.ended_ns))
            && catalogue::entry(&node.sessions_dir, &node.name, &job.session)
                .is_some_and(|entry| entry.session_id.as_ref() != Some(&job.session_id))
    })
}

/// Names of all sessions that any node has recorded.
fn names(config: &WorkerConfig) -> BTreeSet<String> {
    let mut names = BTreeSet::new();
    for node in &config.nodes {
        let entries = std::fs::read_dir(&node.sessions_dir).into_iter().flatten().flatten();
        let recorded = entries.filter(|entry| crate::record::node_dir(&entry.path(), &node.name).is_dir());
        let named = recorded.filter_map(|entry| entry.file_name().into_string().ok());
        names.extend(named.filter(|name| SessionName::parse(name).is_ok()));
    }
    names
}

/// The recordings of a session, when all nodes have closed theirs; the reason why not, otherwise.
pub fn parts(config: &WorkerConfig, name: &str) -> Result<Found, String> {
    let mut entries: Vec<CatalogueEntry> = Vec::new();
    for node in &config.nodes {
        let entry = catalogue::entry(&node.sessions_dir, &node.name, name).ok_or_else(|| {
            let dir = node.sessions_dir.display();
            format!(
                "no recording of node {} in {dir}; is it mounted, and was the node in the session?",
                node.name
            )
        })?;
        if let Some(problem) = &entry.problem {
            return Err(format!("the recording of node {}: {problem}", node.name));
        }
        if entry.verdict.is_none() || entry.session_id.is_none() {
            return Err(format!("the recording of node {} has no verdict yet", node.name));
        }
        entries.push(entry);
    }
    let first = entries.first().ok_or("no nodes")?;
    if let Some(other) = entries.iter().find(|entry| entry.session_id != first.session_id) {
        let (a, b) = (first.path.display(), other.path.display());
        return Err(format!("{a} and {b} are of two sessions; keep those of one together"));
    }
    let verdicts = entries.iter().filter_map(|entry| entry.verdict.as_ref());
    let frames = verdicts.clone().flat_map(|verdict| &verdict.cameras).map(|camera| camera.frames).sum();
    Ok(Found {
        name: name.to_owned(),
        session_id: first.session_id.clone().unwrap_or_default(),
        created_ns: entries.iter().map(|entry| entry.created_ns).min().unwrap_or(0),
        triggers: verdicts.map(|verdict| verdict.triggers).max().unwrap_or(0),
        frames,
        parts: entries.into_iter().map(|entry| entry.path).collect(),
    })
}
