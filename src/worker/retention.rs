// SPDX-License-Identifier: MIT OR Apache-2.0
//! Making room: recordings that are verified, reconstructed and copied may be deleted, by name, when somebody asks for it.

use super::queue::{self, Found};
use super::state::{Job, Stage};
use crate::batch::collect_shards;
use crate::batch::run::Format;
use crate::batch::summary::Summary;
use crate::config::WorkerConfig;
use crate::record::verify::{Severity, verify};
use serde::Serialize;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

/// Of all frames with light, so many have a cloud where a recording may go: of the rest a later version could make more. A camera whose
/// frames are all refused is an eighth.
pub const SHARE_OF_LIT: f64 = 0.99;

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
    judgement.stays.extend(not_reconstructed(config, &found));
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

fn not_reconstructed(config: &WorkerConfig, found: &Found) -> Option<String> {
    let (session, session_id) = (&found.name, &found.session_id);
    let job = match Job::load(&config.results, session) {
        Some(job) if job.stage == Stage::Done => job,
        Some(Job { stage: Stage::SetAside, reason, .. }) => {
            let reason = reason.unwrap_or_else(|| "for no stated reason".to_owned());
            return Some(format!("it was set aside, not reconstructed: {reason}"));
        }
        _ => return Some("it is not reconstructed yet".to_owned()),
    };
    if job.session_id != *session_id {
        return Some(format!("its results are of another session of this name ({})", job.session_id));
    }
    let dir = config.results.join(session);
    let summary = match collect_shards::load_summary(&dir) {
        Ok(summary) => summary,
        Err(reason) => return Some(reason),
    };
    if summary.session.id != *session_id {
        return Some(format!("{} has the results of another session, {}", dir.display(), summary.session));
    }
    if let Some(reason) = too_few_clouds(found.frames, &summary) {
        return Some(reason);
    }
    let there = summary.triggers.len() as u64;
    if there != job.of {
        return Some(format!("{} frame sets were recorded, {there} are in {}", job.of, dir.display()));
    }
    // Whatever is configured for sessions to come.
    let lacking =
        [Format::Phase, Format::Ply].map(|format| collect_shards::without_files(&dir, &[format], &summary));
    let fewest = lacking.iter().min_by_key(|lacking| lacking.len()).filter(|lacking| !lacking.is_empty())?;
    Some(format!("{} has no whole results of {}", dir.display(), collect_shards::named(fewest)))
}

/// Whether clouds are lacking of frames that are in the recordings, and have light.
fn too_few_clouds(recorded: u64, summary: &Summary) -> Option<String> {
    let lit = recorded.saturating_sub(summary.dark() as u64);
    let clouds = summary.clouds as u64;
    if lit > 0 && clouds as f64 >= SHARE_OF_LIT * lit as f64 {
        return None;
    }
    let most =
        summary.most_refused_for().map_or_else(String::new, |reason| format!("; most often: {reason}"));
    Some(format!(
        "{clouds} clouds of {lit} frames with light ({recorded} recorded), expected {:.0} % at least{most}",
        100.0 * SHARE_OF_LIT
    ))
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

#[cfg(test)]
mod tests {
    use super::too_few_clouds;
    use crate::batch::summary::Summary;
    use serde_json::json;

    /// A summary of so many clouds, frames refused with light, and frames refused without.
    fn summary(clouds: u64, refused: u64, dark: u64) -> Summary {
        let frame = |outcome: &str, reason: Option<&str>| {
            let mut frame = json!({
                "camera": "h0_up", "outcome": outcome, "points": 0, "unresolved_px": 0
            });
            reason.into_iter().for_each(|reason| frame["reason"] = reason.into());
            frame
        };
        let mut frames = vec![frame("cloud", None); clouds as usize];
        frames.extend(vec![frame("refused", Some("no marker was found")); refused as usize]);
        frames.extend(vec![frame("refused", Some("there is no object in the frame")); dark as usize]);
        let summary = json!({
            "session": { "id": "s", "cameras": ["h0_up"] }, "algorithm": 1, "parameters": "p", "method": "joint",
            "frames": clouds + refused + dark, "clouds": clouds, "refused": refused + dark, "gaps": 0, "damaged": 0,
            "triggers": [{ "trigger": 0, "frames": frames }]
        });
        serde_json::from_value(summary).expect("a summary")
    }

    #[test]
    fn a_recording_goes_only_where_as_good_as_all_frames_with_light_have_clouds() {
        assert_eq!(too_few_clouds(1000, &summary(990, 10, 0)), None);
        assert_eq!(
            too_few_clouds(2000, &summary(990, 10, 1000)),
            None,
            "nothing is lost where there is no light"
        );
        let stays = |recorded: u64, summary: &Summary, words: &str| {
            let reason = too_few_clouds(recorded, summary).expect("must stay");
            assert!(reason.contains(words), "{reason}");
        };
        stays(1000, &summary(989, 11, 0), "989 clouds of 1000 frames with light");
        stays(1000, &summary(875, 125, 0), "most often: no marker was found");
        stays(1000, &summary(500, 0, 0), "500 clouds of 1000");
        stays(1000, &summary(0, 0, 1000), "0 clouds of 0 frames with light (1000 recorded)");
        stays(0, &summary(0, 0, 0), "0 clouds");
    }
}
