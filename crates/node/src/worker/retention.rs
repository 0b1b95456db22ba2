// SPDX-License-Identifier: MIT OR Apache-2.0
//! Making room: recordings that are verified, reconstructed and copied may be deleted, by name, on request.

use super::queue::{self, Found};
use super::second_copy::{self, SecondCopy};
use super::state::{Job, Stage};
use crate::batch::collect_shards;
use crate::batch::run::Format;
use crate::batch::summary::Summary;
use crate::config::WorkerConfig;
use crate::record::verify::{Severity, verify};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Least share of the frames with light that must have a cloud before a recording may be deleted: a later version
/// could make more of the rest. A camera whose frames are all refused is an eighth.
pub const SHARE_OF_LIT: f64 = 0.99;

/// Whether a session's recordings may be deleted.
#[derive(Debug, Serialize)]
pub struct Judgement {
    pub session: String,
    pub parts: Vec<PathBuf>,
    /// Size of all its recordings together, bytes.
    pub bytes: u64,
    /// Why they must stay; nothing: they may go.
    pub stays: Vec<String>,
    /// Their copies, as they were compared.
    #[serde(skip)]
    copies: Vec<SecondCopy>,
}

/// Judges a session. `thoroughly`: every byte is compared with the archive, and what lies there is verified; otherwise
/// only what can be seen at a glance.
pub fn judge(config: &WorkerConfig, session: &str, thoroughly: bool) -> Judgement {
    let mut judgement = Judgement {
        session: session.to_owned(),
        parts: Vec::new(),
        bytes: 0,
        stays: Vec::new(),
        copies: Vec::new(),
    };
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
        judgement.bytes += second_copy::list(part).map_or(0, |files| files.values().sum());
        let opened = SecondCopy::open(part, &copy).and_then(|pair| {
            if thoroughly {
                pair.compare()?;
            }
            Ok(pair)
        });
        match opened {
            Ok(pair) => judgement.copies.push(pair),
            Err(reason) => judgement.stays.push(reason),
        }
        // What stays behind is the copy: it is read again, from there.
        if thoroughly && judgement.stays.is_empty() {
            judgement.stays.extend(not_verified(&copy));
        }
    }
    judgement
}

/// Deletes the recordings of a session that was just judged, thoroughly, that it may go. Returns the bytes gained.
///
/// # Errors
/// Why one of them stays: what has changed since, or what the system reports.
pub fn delete(judgement: &Judgement) -> Result<u64, String> {
    if !judgement.stays.is_empty() || judgement.copies.len() != judgement.parts.len() {
        return Err(judgement.stays.join("; "));
    }
    for (part, copy) in judgement.parts.iter().zip(&judgement.copies) {
        // Out of sight first: half a recording must never look like one.
        let session = part.parent().unwrap_or(Path::new("."));
        let sessions = session.parent().unwrap_or(Path::new("."));
        let name = part.file_name().unwrap_or_default().to_string_lossy();
        copy.delete(&sessions.join(format!(".pruned-{}-{name}", judgement.session)))?;
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

#[cfg(test)]
mod tests {
    use super::too_few_clouds;
    use crate::batch::summary::Summary;
    use serde_json::json;

    /// A summary with these numbers of clouds, frames refused with light, and frames refused without.
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
