//! Making room: recordings that are verified, reconstructed and copied may be deleted, by name, when somebody asks for it.

use super::queue;
use super::state::{Job, Stage};
use crate::config::WorkerConfig;
use crate::reconstruct::{batch::Format, collect};
use crate::record::verify::{Severity, verify};
use serde::Serialize;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

/// Read at a time while comparing, bytes.
const BLOCK: usize = 1 << 20;

/// Whether a session's recordings may be deleted.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Judgement {
    /// The session.
    pub session: String,
    /// Its recordings.
    pub parts: Vec<PathBuf>,
    /// Their size, bytes.
    pub bytes: u64,
    /// Why they must stay; nothing: they may go.
    pub stays: Vec<String>,
}

/// Judges a session. `thoroughly`: every byte is verified and compared with the archive, otherwise only what can be seen at a glance.
pub fn judge(config: &WorkerConfig, session: &str, thoroughly: bool) -> Judgement {
    let mut judgement =
        Judgement { session: session.to_owned(), parts: Vec::new(), bytes: 0, stays: Vec::new() };
    let found = match queue::parts(config, session) {
        Ok(found) => found,
        Err(reason) => {
            judgement.stays.push(reason);
            return judgement;
        }
    };
    judgement.parts = found.parts.clone();
    judgement.stays.extend(not_reconstructed(config, session, &found.session_id));
    let Some(archive) = &config.archive else {
        judgement.stays.push("no archive is configured; set archive in the worker file".to_owned());
        return judgement;
    };
    for part in &found.parts {
        let copy = archive.join(session).join(part.file_name().unwrap_or_default());
        match files(part) {
            Ok(files) => {
                judgement.bytes += files.iter().map(|(_, bytes)| bytes).sum::<u64>();
                judgement.stays.extend(not_copied(part, &copy, &files, thoroughly));
            }
            Err(error) => judgement.stays.push(format!("{}: {error}", part.display())),
        }
        // What is not the same as its copy needs no further look.
        if thoroughly && judgement.stays.is_empty() {
            judgement.stays.extend(not_verified(part));
        }
    }
    judgement
}

/// Deletes the recordings of a session that was just judged, thoroughly, that it may go. Returns the bytes gained.
pub fn delete(judgement: &Judgement) -> io::Result<u64> {
    if !judgement.stays.is_empty() {
        return Err(io::Error::other(judgement.stays.join("; ")));
    }
    for part in &judgement.parts {
        // Out of sight first: half a recording must never look like one.
        let session = part.parent().unwrap_or(Path::new("."));
        let sessions = session.parent().unwrap_or(Path::new("."));
        let name = part.file_name().unwrap_or_default().to_string_lossy();
        let doomed = sessions.join(format!(".pruned-{}-{name}", judgement.session));
        std::fs::rename(part, &doomed)?;
        std::fs::remove_dir_all(&doomed)?;
        // The other node's recording may still be in it.
        let _ = std::fs::remove_dir(session);
    }
    Ok(judgement.bytes)
}

fn not_reconstructed(config: &WorkerConfig, session: &str, session_id: &str) -> Option<String> {
    let Some(job) = Job::load(&config.results, session).filter(|job| job.stage == Stage::Done) else {
        return Some("it is not reconstructed yet".to_owned());
    };
    if job.session_id != session_id {
        return Some(format!("its results are of another session of this name ({})", job.session_id));
    }
    let dir = config.results.join(session);
    let summary = match collect::load_summary(&dir) {
        Ok(summary) => summary,
        Err(reason) => return Some(reason),
    };
    let there = summary.triggers.len() as u64;
    if there != job.of {
        return Some(format!("{} frame sets were recorded, {there} are in {}", job.of, dir.display()));
    }
    // Whatever is configured for sessions to come.
    let lacking = [Format::Phase, Format::Ply].map(|format| collect::without_files(&dir, format, &summary));
    let fewest = lacking.iter().min_by_key(|lacking| lacking.len()).filter(|lacking| !lacking.is_empty())?;
    Some(format!("{} has no whole results of {}", dir.display(), collect::named(fewest)))
}

fn not_verified(part: &Path) -> Option<String> {
    match verify(part, &|_, _| ()) {
        Ok(report) if report.worst != Some(Severity::Corrupt) => None,
        Ok(_) => Some(format!("{}: verify finds it corrupt", part.display())),
        Err(error) => Some(format!("{}: {error}", part.display())),
    }
}

fn not_copied(part: &Path, copy: &Path, files: &[(PathBuf, u64)], thoroughly: bool) -> Option<String> {
    for (name, bytes) in files {
        let (from, to) = (part.join(name), copy.join(name));
        match std::fs::metadata(&to) {
            Err(error) => return Some(format!("{}: {error}", to.display())),
            Ok(metadata) if metadata.len() != *bytes => {
                return Some(format!("{} has {} bytes, the recording {bytes}", to.display(), metadata.len()));
            }
            Ok(_) => {}
        }
        if thoroughly {
            match same(&from, &to) {
                Ok(true) => {}
                Ok(false) => return Some(format!("{} differs from the recording", to.display())),
                Err(error) => return Some(format!("{}: {error}", to.display())),
            }
        }
    }
    None
}

/// Names and sizes of a recording's files, which has no folders.
fn files(part: &Path) -> io::Result<Vec<(PathBuf, u64)>> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(part)? {
        let entry = entry?;
        files.push((PathBuf::from(entry.file_name()), entry.metadata()?.len()));
    }
    files.sort();
    Ok(files)
}

/// Whether two files have the same bytes.
fn same(a: &Path, b: &Path) -> io::Result<bool> {
    let (mut a, mut b) = (File::open(a)?, File::open(b)?);
    let (mut left, mut right) = (vec![0; BLOCK], vec![0; BLOCK]);
    loop {
        let n = a.read(&mut left)?;
        if n == 0 {
            return Ok(b.read(&mut right)? == 0);
        }
        match b.read_exact(&mut right[..n]) {
            Ok(()) if left[..n] == right[..n] => {}
            Ok(()) => return Ok(false),
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => return Ok(false),
            Err(error) => return Err(error),
        }
    }
}
