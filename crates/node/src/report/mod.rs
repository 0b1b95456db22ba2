// SPDX-License-Identifier: MIT OR Apache-2.0
//! The report of a session, one page: verdict, gaps, light, latencies, points, a turning cloud.
//!
//! The page is one HTML file that needs nothing else: pictures, points and the script that turns them are inside.

mod page;

pub use page::{END, Playing, render};

use crate::acquire::preview::Sample;
use crate::base::ids::TriggerIndex;
use crate::batch::collect_shards;
use crate::batch::result::Clouds;
use crate::batch::summary::TriggerSummary;
use crate::data::FrameSource;
use crate::preview::quick_look::{POINTS_MAX, encode};
use crate::preview::{Exposure, Light, Peaks, measure, upright_png};
use crate::record::describe::{self, CameraDescription, Sheet};
use crate::record::{
    GapRun, ReadError, RecordingReader, SessionReader, Unreadable, Verdict, WriteStatistics,
};
use std::path::{Path, PathBuf};

/// Frames of each camera that are measured, spread over the session.
const LOOKS: u64 = 5;

/// One camera of the session.
#[derive(Debug, Clone)]
pub struct CameraReport {
    /// Outcomes of its triggers, and its settings.
    pub described: CameraDescription,
    /// Runs of triggers without a frame, with their cause.
    pub gaps: Vec<GapRun>,
    /// Trigger and light of some frames, spread over the session.
    pub light: Vec<(u64, Light)>,
    /// The exposure that would be right, by all of those frames; `None` without fringes.
    pub exposure: Option<Exposure>,
    /// A frame from the middle of the session, upright, as PNG.
    pub picture: Option<Vec<u8>>,
    /// Trigger and points of each reconstructed frame.
    pub points: Vec<(u64, u64)>,
}

/// What the page shows of one node's recording.
#[derive(Debug, Clone)]
pub struct NodeReport {
    /// Name of the node in the rig.
    pub node: String,
    /// Directory of the recording, or the single segment.
    pub path: PathBuf,
    /// The stored verdict; `None` where it was not finished.
    pub verdict: Option<Verdict>,
    /// How the disk kept up.
    pub statistics: Option<WriteStatistics>,
    /// Its recording as `fourdbody info` describes it.
    pub sheet: Sheet,
    /// Its cameras, in the order of the recording.
    pub cameras: Vec<CameraReport>,
}

/// What the page shows of a session.
#[derive(Debug, Clone)]
pub struct Report {
    /// Name of the session, that of its directory.
    pub session: String,
    /// When the session was begun, host clock, ns.
    pub created_ns: u64,
    /// Pseudonym of the subject, where one was given.
    pub subject: Option<String>,
    /// Free text of the operator, where one was given.
    pub note: Option<String>,
    /// Triggers per second, as the header states it.
    pub trigger_rate_hz: f64,
    /// Triggers of the session, the most that a node has.
    pub triggers: u64,
    /// The nodes that recorded it.
    pub nodes: Vec<NodeReport>,
    /// Recordings of the session of which nothing can be read.
    pub unreadable: Vec<Unreadable>,
    /// Files of the result that are missing, and those left out, a sentence each.
    pub amiss: Vec<String>,
    /// Trigger and points (see [`encode`]) of the cloud on the page.
    pub cloud: Option<(u64, Vec<u8>)>,
}

/// Collects the facts of a session, and of what was reconstructed of it in `result` (the directory of `fourdbody
/// reconstruct`).
pub fn gather(session: &Path, result: Option<&Path>) -> Result<Report, ReadError> {
    let reader = SessionReader::open(session)?;
    let of_result = |error: String| match result {
        Some(result) if !result.exists() => ReadError::Absent(error),
        _ => ReadError::Unreadable(error),
    };
    let points =
        result.map(|result| points_of(result, &reader)).transpose().map_err(of_result)?.unwrap_or_default();
    let clouds = result.map(clouds_of).transpose().map_err(of_result)?.flatten();
    let amiss = clouds.as_ref().map_or_else(Vec::new, |clouds| clouds.amiss(&(0..u64::MAX)));
    let cloud = clouds.as_ref().map(cloud_of).transpose().map_err(of_result)?.flatten();
    let none = || ReadError::Unreadable(format!("{}: no recording", session.display()));
    let header = &reader.recordings().first().ok_or_else(none)?.header;
    let nodes = reader.recordings().iter().map(|recording| node(recording, &points)).collect();
    Ok(Report {
        session: header.session.to_string(),
        created_ns: header.created_ns,
        subject: header.subject.clone(),
        note: header.note.clone(),
        trigger_rate_hz: header.trigger_rate_hz,
        triggers: reader.recordings().iter().map(RecordingReader::triggers_end).max().unwrap_or(0),
        nodes,
        unreadable: reader.unreadable().to_vec(),
        amiss,
        cloud,
    })
}

fn node(recording: &RecordingReader, points: &[Points]) -> NodeReport {
    let gaps = recording.gap_runs();
    let cameras = describe::cameras(recording).into_iter().zip(gaps).enumerate();
    NodeReport {
        node: recording.header.node.to_string(),
        path: recording.path.clone(),
        verdict: recording.verdict.clone(),
        statistics: recording.statistics,
        sheet: Sheet::of(recording),
        cameras: cameras
            .map(|(place, (described, gaps))| {
                let samples = samples(recording, place);
                let name = described.header.id.as_str();
                let own = points.iter().filter(|(_, camera, _)| camera == name);
                CameraReport {
                    points: own.map(|(trigger, _, points)| (*trigger, *points)).collect(),
                    light: samples.iter().map(|sample| (sample.trigger, measure(sample))).collect(),
                    exposure: exposure(&samples),
                    picture: samples.get(samples.len() / 2).and_then(|sample| upright_png(sample).ok()),
                    described,
                    gaps,
                }
            })
            .collect(),
    }
}

fn exposure(samples: &[Sample]) -> Option<Exposure> {
    let mut peaks = Peaks::default();
    samples.iter().for_each(|sample| peaks.add(sample.width, &sample.pixels));
    peaks.exposure()
}

/// Some frames of a camera, spread over the session; fewer where there are gaps.
fn samples(recording: &RecordingReader, camera: usize) -> Vec<Sample> {
    let end = recording.triggers_end();
    let at = |i: u64| (2 * i + 1) * end / (2 * LOOKS);
    let mut triggers: Vec<u64> = (0..LOOKS.min(end)).map(at).collect();
    triggers.dedup();
    let sample = |trigger: u64| {
        let frame = recording.frame(camera, TriggerIndex(trigger)).ok()?.ok()?;
        let mut sample = Sample::default();
        sample.fill(&frame.meta, frame.image.as_slice(), None);
        Some(sample)
    };
    triggers.into_iter().filter_map(sample).collect()
}

/// Trigger, name of the camera, and points of its cloud.
type Points = (u64, String, u64);

/// Points of all frames from `summary.json` of a reconstruction, which must be of this session.
fn points_of(result: &Path, session: &SessionReader) -> Result<Vec<Points>, String> {
    let summary = collect_shards::load_summary(result)
        .map_err(|e| format!("{e}; expected the directory of `fourdbody reconstruct --out`"))?;
    let expected = session.identity()?;
    if summary.session.id != expected.id {
        return Err(format!(
            "{}: has the results of the session {}, expected {expected}; give those of this session with --clouds",
            result.display(),
            summary.session
        ));
    }
    let frames = summary.triggers.into_iter().flat_map(|TriggerSummary { trigger, frames, .. }| {
        frames.into_iter().map(move |frame| (trigger, frame.camera.to_string(), frame.points as u64))
    });
    Ok(frames.collect())
}

/// The reconstructed clouds; `None` where there are none.
fn clouds_of(result: &Path) -> Result<Option<Clouds>, String> {
    let is_there = ["phases", "clouds", "merged"].iter().any(|folder| result.join(folder).is_dir());
    is_there.then(|| Clouds::open(result)).transpose()
}

/// The merged cloud in the middle of what was reconstructed.
fn cloud_of(clouds: &Clouds) -> Result<Option<(u64, Vec<u8>)>, String> {
    let Some((trigger, place)) = clouds.merged.iter().nth(clouds.merged.len() / 2) else { return Ok(None) };
    let (_, cloud) = clouds.load(place)?;
    Ok(Some((*trigger, encode(&cloud, POINTS_MAX))))
}
