// SPDX-License-Identifier: MIT OR Apache-2.0
//! Results in the store: what is finished comes first, what is made goes back while the work goes on.

use super::remote::{Object, Remote};
use crate::batch::key::COMMON_FILES;
use rayon::prelude::*;
use std::collections::{BTreeSet, HashMap};
use std::fs::Metadata;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// Folders of files that belong to one trigger each, and the ends of their names.
const FOLDERS: [(&str, &str); 3] = [("clouds", ".ply"), ("merged", ".ply"), ("phases", ".phase")];
/// Time between two looks for finished files.
const LOOK: Duration = Duration::from_millis(500);

/// Fetches the files of the triggers that are wanted, and the objects at the location itself whose names are; whatever
/// they are worth, the reconstruction looks at them as at any file that it finds. Returns the names of those that were
/// fetched: files that a run has left here stay, and may not be in the store.
pub fn fetch(
    remote: &Remote,
    out: &Path,
    wanted: &(dyn Fn(u64) -> bool + Sync),
    named: &(dyn Fn(&str) -> bool + Sync),
) -> Result<BTreeSet<String>, String> {
    let mut objects: Vec<Object> =
        remote.list("")?.0.into_iter().filter(|object| named(&object.name)).collect();
    for (folder, end) in FOLDERS {
        let trigger = |name: &str| name.strip_suffix(end)?.rsplit(['_', '/']).next()?.parse().ok();
        let found = remote.list(folder)?.0.into_iter();
        objects.extend(found.filter(|object| trigger(&object.name).is_some_and(wanted)));
    }
    let folders = objects.iter().filter_map(|object| Path::new(&object.name).parent());
    for folder in folders.collect::<BTreeSet<_>>() {
        let folder = out.join(folder);
        std::fs::create_dir_all(&folder).map_err(|e| format!("{}: {e}", folder.display()))?;
    }
    let has = |object: &Object| out.join(&object.name).metadata().is_ok_and(|file| file.len() == object.size);
    super::with_many_requests(|| {
        let lacking = objects.par_iter().filter(|object| !has(object));
        let fetched =
            lacking.map(|object| remote.fetch(object, &out.join(&object.name)).map(|()| object.name.clone()));
        fetched.collect()
    })
}

/// Sends files as they are finished.
pub struct Uploader {
    files: Arc<Files>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<Sent>>,
}

struct Files {
    remote: Arc<Remote>,
    out: PathBuf,
}

/// What the store has, by name: the very file, since one that is made anew has another inode or time.
type Sent = HashMap<String, (u64, i64, i64)>;

fn identity(metadata: &Metadata) -> (u64, i64, i64) {
    (metadata.ino(), metadata.mtime(), metadata.mtime_nsec())
}

impl Uploader {
    /// Of what is in `out` now, the store has these.
    pub fn start(remote: Arc<Remote>, out: PathBuf, fetched: &BTreeSet<String>) -> std::io::Result<Self> {
        let files = Arc::new(Files { remote, out });
        let sent: Sent = files.finished().into_iter().filter(|(name, _)| fetched.contains(name)).collect();
        let stop = Arc::new(AtomicBool::new(false));
        let thread = {
            let (files, stop) = (Arc::clone(&files), Arc::clone(&stop));
            std::thread::Builder::new().name("upload".to_owned()).spawn(move || files.send_on(sent, &stop))?
        };
        Ok(Self { files, stop, thread: Some(thread) })
    }

    /// Sends the files that are left, and ends the thread.
    pub fn finish(mut self) -> Result<(), String> {
        self.stop.store(true, Ordering::Release);
        let mut sent = self.thread.take().and_then(|thread| thread.join().ok()).unwrap_or_default();
        self.files.send(&mut sent)
    }
}

impl Drop for Uploader {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Files {
    /// Names of all finished files: what is being written has another ending.
    fn finished(&self) -> Vec<(String, (u64, i64, i64))> {
        // First: they are in the store before any other file.
        let common = COMMON_FILES.into_iter().filter_map(|name| {
            let metadata = self.out.join(name).metadata().ok()?;
            Some((name.to_owned(), identity(&metadata)))
        });
        let mut found: Vec<_> = common.collect();
        for (folder, end) in FOLDERS {
            for entry in std::fs::read_dir(self.out.join(folder)).into_iter().flatten().flatten() {
                let name = entry.file_name().into_string().ok().filter(|name| name.ends_with(end));
                let Some((name, metadata)) = name.zip(entry.metadata().ok()) else { continue };
                found.push((format!("{folder}/{name}"), identity(&metadata)));
            }
        }
        found
    }

    fn send(&self, sent: &mut Sent) -> Result<(), String> {
        for (name, identity) in self.finished() {
            if sent.get(&name) != Some(&identity) {
                self.remote.put(&name, &self.out.join(&name))?;
                sent.insert(name, identity);
            }
        }
        Ok(())
    }

    /// Sends finished files until `stop` is set. A store that does not answer is tried again; `finish` sends the rest.
    fn send_on(&self, mut sent: Sent, stop: &AtomicBool) -> Sent {
        let mut told = false;
        while !stop.load(Ordering::Acquire) {
            match self.send(&mut sent) {
                Ok(()) => told = false,
                Err(reason) if !told => {
                    tracing::warn!("{reason}; tried again");
                    told = true;
                }
                Err(_) => {}
            }
            std::thread::sleep(LOOK);
        }
        sent
    }
}
