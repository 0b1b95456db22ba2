// SPDX-License-Identifier: MIT OR Apache-2.0
//! The list of a node's recordings, kept in memory: reading it costs a recording under way no frame.
//!
//! One thread at idle priority reads the disk. It reads a recording when it is new or has changed, and never for a
//! single request. Requests wait in a queue of a stated length; those that wait together are answered by one look.

use crate::base::ids::NodeId;
use crate::base::{Exit, Fault};
use crate::capture::numbering::free_in;
use crate::record::catalogue::{CatalogueEntry, entry};
use crate::record::node_dir;
use crate::record::remark::Remark;
use crossbeam_channel::{Receiver, Sender, bounded};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime};
use tokio::sync::oneshot;

/// Number of recordings that are kept in memory: the newest ones.
pub const LISTED_MAX: usize = 1000;
/// Requests that may wait for the thread; a further one is refused.
const WAITING_MAX: usize = 64;
/// Least time between two looks at the disk.
const PAUSE: Duration = Duration::from_millis(250);

/// A request, which sends its own answer: the client may be gone.
type Request = Box<dyn FnOnce(&Index) + Send>;

/// Sends requests to the thread, which ends when the last of these is dropped.
#[derive(Clone)]
pub struct Listing {
    requests: Sender<Request>,
}

impl Listing {
    /// Starts the thread, which begins with a look at everything.
    ///
    /// # Errors
    /// The system gives no thread.
    pub fn start(sessions_dir: PathBuf, node: NodeId) -> std::io::Result<Self> {
        let (requests, inbox) = bounded(WAITING_MAX);
        let mut index = Index { sessions_dir, node, known: BTreeMap::new() };
        std::thread::Builder::new().name("listing".to_owned()).spawn(move || index.run(&inbox))?;
        Ok(Self { requests })
    }

    /// The newest recordings that have this text in name, subject or notes, newest first: a JSON list of at most
    /// `limit` [`CatalogueEntry`].
    ///
    /// # Errors
    /// Too many requests wait.
    pub async fn newest(&self, limit: usize, search: &str) -> Result<String, Fault> {
        let search = search.to_lowercase();
        self.ask(move |index| index.newest(limit, &search)).await
    }

    /// The first name from this one on under which nothing is recorded; or what is wrong with it.
    ///
    /// # Errors
    /// Too many requests wait.
    pub async fn free(&self, wanted: String) -> Result<Result<String, String>, Fault> {
        self.ask(move |index| free_in(&index.sessions_dir, &wanted)).await
    }

    /// The recording of this name as JSON, if there is one.
    ///
    /// # Errors
    /// Too many requests wait.
    pub async fn one(&self, name: String) -> Result<Option<String>, Fault> {
        self.ask(move |index| index.one(&name)).await
    }

    async fn ask<T: Send + 'static>(
        &self,
        question: impl FnOnce(&Index) -> T + Send + 'static,
    ) -> Result<T, Fault> {
        let busy =
            || Fault::new(Exit::Device, "too many requests for the recordings at the same time; try again");
        let (reply, answer) = oneshot::channel();
        let request: Request = Box::new(move |index| drop(reply.send(question(index))));
        self.requests.try_send(request).map_err(|_| busy())?;
        answer.await.map_err(|_| busy())
    }
}

/// What changes when a recording does: compared to read it only once.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Stamp {
    made: SystemTime,
    /// When the remark was last written.
    remarked: Option<SystemTime>,
    /// Size of the files, while the recording is not closed.
    bytes: u64,
    written: Option<SystemTime>,
}

struct Known {
    stamp: Stamp,
    created_ns: u64,
    closed: bool,
    /// What is searched, in small letters.
    text: String,
    json: String,
}

struct Index {
    sessions_dir: PathBuf,
    node: NodeId,
    /// The newest recordings, by the name of their session.
    known: BTreeMap<String, Known>,
}

impl Index {
    fn run(&mut self, inbox: &Receiver<Request>) {
        idle();
        self.look();
        let mut looked = Instant::now();
        while let Ok(first) = inbox.recv() {
            std::thread::sleep(PAUSE.saturating_sub(looked.elapsed()));
            let requests: Vec<Request> = std::iter::once(first).chain(inbox.try_iter()).collect();
            self.look();
            requests.into_iter().for_each(|request| request(self));
            looked = Instant::now();
        }
    }

    fn newest(&self, limit: usize, search: &str) -> String {
        let mut known: Vec<&Known> = self.known.values().filter(|k| k.text.contains(search)).collect();
        known.sort_by_key(|known| std::cmp::Reverse(known.created_ns));
        let listed: Vec<&str> = known.into_iter().take(limit).map(|known| known.json.as_str()).collect();
        format!("[{}]", listed.join(","))
    }

    fn one(&self, name: &str) -> Option<String> {
        // Older recordings are not kept in memory, and are read.
        let older = || serde_json::to_string(&entry(&self.sessions_dir, &self.node, name)?).ok();
        self.known.get(name).map(|known| known.json.clone()).or_else(older)
    }

    fn look(&mut self) {
        let entries = std::fs::read_dir(&self.sessions_dir).into_iter().flatten().flatten();
        let mut found: Vec<(SystemTime, String)> = entries
            .filter_map(|entry| {
                let dir = node_dir(&entry.path(), &self.node);
                let made = std::fs::metadata(dir).ok().filter(std::fs::Metadata::is_dir)?.modified().ok()?;
                Some((made, entry.file_name().into_string().ok()?))
            })
            .collect();
        found.sort_by(|a, b| b.cmp(a));
        found.truncate(LISTED_MAX);
        let mut before = std::mem::take(&mut self.known);
        for (made, name) in found {
            let session = self.sessions_dir.join(&name);
            let remarked = Remark::written(&session, &self.node);
            let same = |known: &Known| known.stamp.made == made && known.stamp.remarked == remarked;
            let known = match before.remove(&name) {
                Some(known) if known.closed && same(&known) => Some(known),
                known => {
                    let stamp = stamp(&node_dir(&session, &self.node), made, remarked);
                    known.filter(|known| known.stamp == stamp).or_else(|| self.read(&name, stamp))
                }
            };
            self.known.extend(known.map(|known| (name, known)));
        }
    }

    fn read(&self, name: &str, stamp: Stamp) -> Option<Known> {
        let entry: CatalogueEntry = entry(&self.sessions_dir, &self.node, name)?;
        let json = serde_json::to_string(&entry).ok()?;
        let remark = entry.remark.and_then(|remark| remark.note);
        let texts = [Some(entry.name), entry.subject, entry.note, remark];
        let text = texts.into_iter().flatten().collect::<Vec<_>>().join("\n").to_lowercase();
        Some(Known { stamp, created_ns: entry.created_ns, closed: entry.verdict.is_some(), text, json })
    }
}

fn stamp(dir: &Path, made: SystemTime, remarked: Option<SystemTime>) -> Stamp {
    let files = std::fs::read_dir(dir).into_iter().flatten().flatten();
    let files: Vec<_> = files.filter_map(|file| file.metadata().ok()).collect();
    let bytes = files.iter().map(std::fs::Metadata::len).sum();
    Stamp { made, remarked, bytes, written: files.iter().filter_map(|file| file.modified().ok()).max() }
}

/// Puts this thread at idle priority.
fn idle() {
    let parameters = libc::sched_param { sched_priority: 0 };
    // SAFETY: the parameters are valid during the call, and 0 is the calling thread.
    if unsafe { libc::sched_setscheduler(0, libc::SCHED_IDLE, &raw const parameters) } != 0 {
        tracing::warn!(
            "the list of recordings is not made at idle priority: {}",
            std::io::Error::last_os_error()
        );
    }
}

#[cfg(test)]
mod tests {
    use super::{Index, Remark};
    use crate::base::ids::NodeId;
    use std::collections::BTreeMap;

    #[test]
    fn what_comes_goes_and_changes_is_seen() {
        let dir = tempfile::tempdir().expect("a directory");
        let node_dir = dir.path().join("walk/node-a");
        std::fs::create_dir_all(&node_dir).expect("made");
        let mut index =
            Index { sessions_dir: dir.path().to_owned(), node: NodeId::from("a"), known: BTreeMap::new() };
        let mut listed = || {
            index.look();
            index.newest(10, "")
        };
        std::fs::write(node_dir.join("segment-000.mcap"), b"").expect("written");
        assert!(listed().contains(r#""name":"walk""#) && listed().contains(r#""bytes":0"#));
        std::fs::write(node_dir.join("segment-000.mcap"), b"12345").expect("written");
        assert!(listed().contains(r#""bytes":5"#), "{}", listed());
        let remark = Remark { rating: None, note: Some("Left ARM".to_owned()) };
        remark.save(&dir.path().join("walk"), &NodeId::from("a")).expect("writable");
        assert!(listed().contains("Left ARM"), "{}", listed());
        let mut found = |search: &str| {
            index.look();
            index.newest(10, search).contains("walk")
        };
        assert!(found("alk") && found("left arm") && !found("right"));
        std::fs::remove_dir_all(dir.path().join("walk")).expect("mine");
        let mut listed = || {
            index.look();
            index.newest(10, "")
        };
        assert_eq!(listed(), "[]");
        assert_eq!(index.one("../walk"), None);
    }
}
