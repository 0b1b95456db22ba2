//! Makes a whole recording of an interrupted or damaged one (`fourdbody recover`).
//!
//! The source is only read. Every frame is checked against its own checksums on the way; what fails becomes a gap record
//! with cause `damaged`, what is absent one that says so. The result is a recording like any other, with index and
//! verdict; `docs/design/recording.md` states what it must keep.

use super::layout::{GapCause, NodeEvent, TriggerRecord};
use super::reader::{Extent, Outcome, ReadError, RecordingReader, check_frame};
use super::scan::End;
use super::session::SessionReader;
use super::verdict::{SessionEnd, Verdict};
use super::writer::{RecordError, Recording, WriterOptions};
use crate::ids::{CameraId, TriggerIndex};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// What became of one recording.
#[derive(Debug, Clone, Serialize)]
pub struct Recovered {
    /// The source.
    pub source: PathBuf,
    /// The result.
    pub directory: PathBuf,
    /// Frames passed on, per camera in the header's order.
    pub frames: Vec<(CameraId, u64)>,
    /// Frames that were there, but failed their checksums.
    pub damaged: u64,
    /// Outcomes that were absent from the source.
    pub absent: u64,
    /// The source was closed properly, and nothing was wrong with it.
    pub was_whole: bool,
    /// Of the result.
    pub verdict: Verdict,
}

/// Why nothing could be recovered.
#[derive(Debug, thiserror::Error)]
pub enum RecoverError {
    /// The source cannot be read at all.
    #[error("{0}")]
    Source(#[from] ReadError),
    /// The result cannot be written.
    #[error("{0}")]
    Target(Box<RecordError>),
}

impl From<RecordError> for RecoverError {
    fn from(error: RecordError) -> Self {
        Self::Target(Box::new(error))
    }
}

/// Recovers a session, a recording or one segment into `out`; `progress` gets the triggers done and all triggers.
pub fn recover(
    source: &Path,
    out: &Path,
    mut progress: impl FnMut(u64, u64),
) -> Result<Vec<Recovered>, RecoverError> {
    let session = SessionReader::open_extent(source, Extent::Salvage)?;
    let recordings = session.recordings();
    // Both nodes saw the same triggers: what one knows of, the other must account for.
    let end = recordings.iter().map(RecordingReader::triggers_end).max().unwrap_or(0);
    let total = end * recordings.len() as u64;
    let mut results = Vec::new();
    for (place, recording) in recordings.iter().enumerate() {
        let directory = out.join(format!("node-{}", recording.header.node));
        let before = place as u64 * end;
        results.push(one(recording, &directory, end, |done| progress(before + done, total))?);
    }
    Ok(results)
}

fn one(
    source: &RecordingReader,
    directory: &Path,
    end: u64,
    mut progress: impl FnMut(u64),
) -> Result<Recovered, RecoverError> {
    let mut target = Recording::create(directory, source.header.clone(), WriterOptions::default())?;
    let mut frames = vec![0; source.header.cameras.len()];
    let (mut damaged, mut absent) = (0, 0);
    let mut small = SmallRecords::of(source);
    let last: Vec<u64> =
        source.outcomes.iter().map(|o| o.last_key_value().map_or(0, |(trigger, _)| trigger + 1)).collect();
    for trigger in 0..end {
        let index = TriggerIndex(trigger);
        if let Some(row) = source.triggers.get(&index) {
            small.write_until(row.host_time_ns, &mut target)?;
            target.trigger(row)?;
        }
        for camera in 0..frames.len() {
            let cause = match source.outcomes[camera].get(&trigger) {
                Some(Outcome::Gap(cause)) => *cause,
                Some(&Outcome::Frame { segment, offset, length }) => {
                    match copy(source, &mut target, camera, index, (segment, offset, length))? {
                        true => {
                            frames[camera] += 1;
                            continue;
                        }
                        false => {
                            damaged += 1;
                            GapCause::Damaged
                        }
                    }
                }
                None => {
                    absent += 1;
                    // Behind a camera's last outcome the recording had stopped; before it something is broken.
                    if trigger >= last[camera] { GapCause::Aborted } else { GapCause::Damaged }
                }
            };
            target.gap(camera, index, cause)?;
        }
        progress(trigger + 1);
    }
    small.write_until(u64::MAX, &mut target)?;
    let stated = source.verdict.clone();
    let closed = source.segments.iter().all(|segment| segment.end == End::Closed);
    let was_whole = closed && stated.is_some() && source.problems.is_empty() && damaged == 0 && absent == 0;
    let why = format!("recovered from {}", source.path.display());
    if !was_whole {
        target.event(&NodeEvent {
            host_time_ns: small.newest_ns,
            kind: "recovered".to_owned(),
            camera: None,
            trigger: None,
            message: format!(
                "{why}: {damaged} damaged frames and {absent} absent outcomes became gap records"
            ),
        })?;
    }
    let interrupted = (!was_whole).then_some(why);
    let verdict = target.finish(SessionEnd {
        triggers_emitted: stated.as_ref().and_then(|verdict| verdict.triggers_emitted),
        aborted: stated.and_then(|verdict| verdict.aborted).or(interrupted),
        absent: GapCause::Unknown,
        host_time_ns: small.newest_ns,
    })?;
    let named = source.header.cameras.iter().map(|camera| camera.id.clone()).zip(frames);
    Ok(Recovered {
        source: source.path.clone(),
        directory: directory.to_owned(),
        frames: named.collect(),
        damaged,
        absent,
        was_whole,
        verdict,
    })
}

/// Passes a frame on if it is intact, and says whether it was.
fn copy(
    source: &RecordingReader,
    target: &mut Recording,
    camera: usize,
    trigger: TriggerIndex,
    (segment, offset, length): (usize, usize, usize),
) -> Result<bool, RecoverError> {
    let message = source.segments.get(segment).and_then(|segment| segment.message(offset, length));
    let checked = message
        .and_then(|message| Some((message, check_frame(message, camera, trigger, &source.header).ok()?)));
    let Some((message, frame)) = checked else { return Ok(false) };
    target.frame(camera, &frame.meta, message)?;
    Ok(true)
}

/// Events and clock samples, which go between the triggers where they were.
struct SmallRecords<'a> {
    source: &'a RecordingReader,
    events: usize,
    samples: usize,
    newest_ns: u64,
}

impl<'a> SmallRecords<'a> {
    fn of(source: &'a RecordingReader) -> Self {
        let table = source.triggers.values().map(|row: &TriggerRecord| row.host_time_ns);
        let times = source.events.iter().map(|event| event.host_time_ns).chain(table);
        let newest_ns = times.max().unwrap_or(source.header.created_ns);
        Self { source, events: 0, samples: 0, newest_ns }
    }

    fn write_until(&mut self, host_ns: u64, target: &mut Recording) -> Result<(), RecoverError> {
        while let Some(sample) =
            self.source.clock_samples.get(self.samples).filter(|s| s.host_receive_ns <= host_ns)
        {
            target.clock_sample(sample)?;
            self.samples += 1;
        }
        while let Some(event) = self.source.events.get(self.events).filter(|e| e.host_time_ns <= host_ns) {
            target.event(event)?;
            self.events += 1;
        }
        Ok(())
    }
}

/// A recording that was not finished.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Interrupted {
    /// Its directory.
    pub path: PathBuf,
    /// Why it is thought to be unfinished.
    pub reason: String,
}

/// Recordings of `node` below `sessions_dir` that were not finished; looks at the last segments' ends only.
pub fn interrupted(sessions_dir: &Path, node: &str) -> Vec<Interrupted> {
    let entries = std::fs::read_dir(sessions_dir).into_iter().flatten().flatten();
    let mut found: Vec<Interrupted> = entries
        .filter_map(|entry| {
            let path = entry.path().join(format!("node-{node}"));
            let reason = super::session::unfinished(&path)?;
            Some(Interrupted { path, reason })
        })
        .collect();
    found.sort_by(|a, b| a.path.cmp(&b.path));
    found
}
