// SPDX-License-Identifier: MIT OR Apache-2.0
//! A reconstruction whose session or results are in an object store: staged in a scratch directory, run there, sent
//! back.

use super::{Args, What};
use crate::base::ids::CameraId;
use crate::base::{Exit, regular};
use crate::batch::collect_shards::summary_path;
use crate::batch::key::COMMON_FILES;
use crate::cmds::failure::Failure;
use crate::s3::remote::Remote;
use crate::s3::results::{self, Uploader};
use crate::s3::{Location, recordings};
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Where things are, and where they are staged.
pub(super) struct Staged {
    session: Option<Remote>,
    out: Option<Arc<Remote>>,
    scratch: PathBuf,
    /// Held as long as it lives.
    _lock: File,
}

fn failed(error: impl std::fmt::Display) -> Failure {
    Failure::new(Exit::Failure, error)
}

/// A name that the same run finds again, and that no other run has.
fn name_of(args: &Args) -> String {
    let what = &args.what;
    let options = what.options(what.triggers.as_ref().unwrap_or(&(0..u64::MAX)));
    let (session, out) = (what.session.to_string_lossy(), what.out.to_string_lossy());
    let run = serde_json::json!([session, out, options, args.shard, args.collect]);
    Sha256::digest(run.to_string()).iter().take(8).map(|byte| format!("{byte:02x}")).collect()
}

/// Makes the scratch directory, and takes it.
fn lock(scratch: &Path) -> Result<File, Failure> {
    let at = |e: std::io::Error| failed(format!("{}: {e}", scratch.display()));
    std::fs::create_dir_all(scratch).map_err(at)?;
    let lock = regular::lock_file(&scratch.join("lock")).map_err(at)?;
    match lock.try_lock() {
        Ok(()) => Ok(lock),
        Err(TryLockError::WouldBlock) => Err(Failure::new(
            Exit::Usage,
            format!(
                "the same run is at work in {}; wait for it, or use another --scratch",
                scratch.display()
            ),
        )),
        Err(TryLockError::Error(error)) => Err(at(error)),
    }
}

impl Staged {
    /// `None` where session and results are paths on this machine.
    pub fn of(args: &Args) -> Result<Option<Self>, Failure> {
        let location = |path: &Path| Location::of(path).transpose().map_err(|e| Failure::new(Exit::Usage, e));
        let (session, out) = (location(&args.what.session)?, location(&args.what.out)?);
        if session.is_none() && out.is_none() {
            return Ok(None);
        }
        let root = args.scratch.clone().unwrap_or_else(std::env::temp_dir);
        let scratch = root.join(format!("fourdbody-{}", name_of(args)));
        let lock = lock(&scratch)?;
        let remote = |location: Option<Location>| location.map(Remote::new).transpose().map_err(failed);
        let (session, out) = (remote(session)?, remote(out)?.map(Arc::new));
        Ok(Some(Self { session, out, scratch, _lock: lock }))
    }

    /// Fetches, runs, and sends; the scratch directory goes when all has been sent.
    pub fn run(self, args: &Args) -> Result<Exit, Failure> {
        let mut what = args.what.clone();
        if let Some(remote) = &self.session {
            what.session = self.scratch.join("session");
            what.is_part = true;
            let wanted = |camera: &CameraId, trigger| self.reads(args, camera, trigger);
            let bytes = recordings::stage(remote, &what.session, &wanted).map_err(failed)?;
            eprintln!("{:.1} MB of the session fetched from {}", bytes as f64 / 1e6, remote.location());
        }
        let mut uploader = None;
        if let Some(remote) = &self.out {
            what.out = self.scratch.join("out");
            let fetched = self.fetch_results(args, remote, &what.out)?;
            uploader = Some(Uploader::start(Arc::clone(remote), what.out.clone(), &fetched).map_err(failed)?);
        }
        let ended = super::run_here(args, &what);
        // What was made is sent whatever came after it.
        let sent = uploader.map_or(Ok(()), Uploader::finish).map_err(|reason| {
            failed(format!("{reason}; what was made waits in {}: run the same again", self.scratch.display()))
        });
        let exit = ended?;
        sent?;
        if let Some(remote) = &self.out {
            self.send_summary(args, remote, &what)?;
        }
        std::fs::remove_dir_all(&self.scratch)
            .map_err(|e| failed(format!("{}: {e}", self.scratch.display())))?;
        Ok(exit)
    }

    /// Whether the run reads a frame.
    fn reads(&self, args: &Args, camera: &CameraId, trigger: u64) -> bool {
        let (i, n) = args.shard.unwrap_or((0, 1));
        let chosen = args.what.triggers.as_ref().is_none_or(|triggers| triggers.contains(&trigger));
        let named = args.what.cameras.is_empty() || args.what.cameras.iter().any(|c| c == camera.as_str());
        args.collect.is_none() && chosen && named && trigger % n.max(1) == i
    }

    fn fetch_results(&self, args: &Args, remote: &Remote, out: &Path) -> Result<BTreeSet<String>, Failure> {
        let (i, n) = args.shard.unwrap_or((0, 1));
        let wanted = |trigger: u64| trigger % n.max(1) == i;
        let shards = args.collect.into_iter().flat_map(|n| (0..n).map(move |i| (i, n)));
        let summaries: Vec<PathBuf> = shards.map(|shard| summary_path(out, Some(shard))).collect();
        let named = |name: &str| COMMON_FILES.contains(&name) || summaries.contains(&out.join(name));
        results::fetch(remote, out, &wanted, &named).map_err(failed)
    }

    /// Sends the files that list the others: summary and sequence.
    fn send_summary(&self, args: &Args, remote: &Remote, what: &What) -> Result<(), Failure> {
        let sequence = what.out.join("sequence.mcap");
        let summary = summary_path(&what.out, args.shard);
        for path in [sequence, summary].iter().filter(|path| path.exists()) {
            let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            remote.put(name, path).map_err(failed)?;
        }
        Ok(())
    }
}
