//! A session: a directory with the recordings of all its nodes, read as one source of frames.

use super::layout::{GapCause, VERDICT_METADATA, segment_number};
use super::reader::{Extent, ReadError, RecordedFrame, RecordingReader};
use super::scan::metadata_by_index;
use super::segment_file::SegmentFile;
use crate::config::Rig;
use crate::ids::{CameraId, NodeId, TriggerIndex};
use crate::reconstruct::{Frame, FrameSource, SessionIdentity, SourceStatement, StatedCamera};
use serde::Serialize;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// The directory of a node's recording inside a session's directory.
pub fn node_dir(session: &Path, node: &NodeId) -> PathBuf {
    session.join(format!("node-{node}"))
}

/// The segments of one recording, in order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordingFiles {
    /// The recording's directory, or the single file.
    pub path: PathBuf,
    /// Number and path.
    pub segments: Vec<(u32, PathBuf)>,
    /// Why the directory cannot be listed, if so.
    pub unlisted: Option<String>,
}

impl RecordingFiles {
    fn of(path: &Path, segments: Vec<(u32, PathBuf)>) -> Self {
        Self { path: path.to_owned(), segments, unlisted: None }
    }
}

/// Finds the recordings at `path`: a session's directory, a recording's, or a single segment.
pub(super) fn find(path: &Path) -> Result<Vec<RecordingFiles>, String> {
    let shown = path.display();
    let expected =
        "expected a session (node-*/segment-*.mcap), a recording (segment-*.mcap) or an .mcap file";
    let kind = std::fs::metadata(path).map_err(|e| format!("{shown}: {e}; {expected}"))?;
    if kind.is_file() {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        let segments = vec![(segment_number(name).unwrap_or(0), path.to_owned())];
        return Ok(vec![RecordingFiles::of(path, segments)]);
    }
    let own = segments(path)?;
    if !own.is_empty() {
        return Ok(vec![RecordingFiles::of(path, own)]);
    }
    let mut recordings = Vec::new();
    for (name, entry) in entries(path)? {
        if name.starts_with("node-") && entry.is_dir() {
            // One that cannot be listed does not hide the others.
            let (segments, unlisted) = match segments(&entry) {
                Ok(segments) => (segments, None),
                Err(reason) => (Vec::new(), Some(reason)),
            };
            recordings.push(RecordingFiles { path: entry, segments, unlisted });
        }
    }
    if recordings.is_empty() {
        return Err(format!("{shown}: nothing recorded here; {expected}"));
    }
    Ok(recordings)
}

fn segments(dir: &Path) -> Result<Vec<(u32, PathBuf)>, String> {
    let found = entries(dir)?.into_iter();
    let mut segments: Vec<_> =
        found.filter_map(|(name, path)| segment_number(&name).map(|number| (number, path))).collect();
    segments.sort();
    Ok(segments)
}

/// Names and paths in a directory, sorted.
fn entries(dir: &Path) -> Result<Vec<(String, PathBuf)>, String> {
    let error = |e: std::io::Error| format!("{}: {e}", dir.display());
    let mut found = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(error)? {
        let entry = entry.map_err(error)?;
        found.extend(entry.file_name().into_string().ok().map(|name| (name, entry.path())));
    }
    found.sort();
    Ok(found)
}

/// Why the recording in `dir` is thought to be unfinished: its last segment is not closed, or states no verdict, or cannot
/// be read. `None` for a finished one, and where there is no recording.
pub(super) fn unfinished(dir: &Path) -> Option<String> {
    let (_, last) = segments(dir).ok()?.pop()?;
    let name = last.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let file = match SegmentFile::open(&last) {
        Ok(file) => file,
        Err(error) => return Some(format!("{name} cannot be opened: {error}")),
    };
    match metadata_by_index(&file) {
        None => Some(match file.bad_ranges().first() {
            Some(bad) => format!("{name}: {bad}"),
            None => format!("{name} was not closed"),
        }),
        Some(metadata) if metadata.iter().any(|(name, _)| *name == VERDICT_METADATA) => None,
        Some(_) => Some(format!("{name} has no verdict")),
    }
}

/// A recording of which nothing can be read.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Unreadable {
    /// Its directory, or the single segment.
    pub path: PathBuf,
    /// The node, by the directory's name; empty where that says nothing.
    pub node: String,
    /// What was expected and found.
    pub reason: String,
}

/// The recordings at `path` (a session, a recording or a segment) that can be read, with all small records; and those that
/// cannot, which do not hide the others.
pub fn open_each(path: &Path) -> Result<(Vec<RecordingReader>, Vec<Unreadable>), ReadError> {
    let (mut readable, mut unreadable) = (Vec::new(), Vec::new());
    for files in find(path).map_err(ReadError)? {
        match RecordingReader::open(&files, Extent::Everything) {
            Ok(recording) => readable.push(recording),
            Err(ReadError(reason)) => {
                let node = node_of_dir(&files.path).unwrap_or_default();
                unreadable.push(Unreadable { path: files.path, node, reason });
            }
        }
    }
    Ok((readable, unreadable))
}

/// The node that a recording's directory is named after.
pub(super) fn node_of_dir(path: &Path) -> Option<String> {
    Some(path.file_name()?.to_str()?.strip_prefix("node-")?.to_owned())
}

/// A session: the recordings of all its nodes.
pub struct SessionReader {
    recordings: Vec<RecordingReader>,
    cameras: Vec<CameraId>,
    /// Recording and place in its header, for each of `cameras`.
    places: Vec<(usize, usize)>,
    triggers: Range<u64>,
}

impl SessionReader {
    /// Opens a session's directory, one recording's directory, or one segment, and reads all small records.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        Self::open_extent(path, Extent::Everything)
    }

    /// As [`Self::open`], but reads closed segments by their indexes only: much faster from a cold disk. Trigger
    /// tables, clock samples and events stay empty.
    pub fn open_frames(path: &Path) -> Result<Self, ReadError> {
        Self::open_extent(path, Extent::Outcomes)
    }

    fn open_extent(path: &Path, what: Extent) -> Result<Self, ReadError> {
        let files = find(path).map_err(ReadError)?;
        let recordings: Vec<RecordingReader> =
            files.iter().map(|files| RecordingReader::open(files, what)).collect::<Result<_, _>>()?;
        let mut places: Vec<(usize, usize)> = Vec::new();
        for (r, recording) in recordings.iter().enumerate() {
            places.extend((0..recording.header.cameras.len()).map(|c| (r, c)));
        }
        let id = |&(r, c): &(usize, usize)| recordings[r].header.cameras[c].id.clone();
        if let Some(rig) = recordings.first().and_then(|r| parse_rig(&r.header.rig_text).ok()) {
            let order: Vec<&CameraId> = rig.cameras().map(|(_, camera)| &camera.id).collect();
            places.sort_by_key(|place| order.iter().position(|o| **o == id(place)).unwrap_or(usize::MAX));
        }
        let cameras: Vec<CameraId> = places.iter().map(id).collect();
        let start =
            recordings.iter().filter_map(|r| r.segments.first()).map(|segment| segment.first_trigger).min();
        let end = recordings.iter().map(RecordingReader::triggers_end).max().unwrap_or(0);
        let triggers = start.unwrap_or(0).min(end)..end;
        Ok(Self { recordings, cameras, places, triggers })
    }

    /// The recordings, by node.
    pub fn recordings(&self) -> &[RecordingReader] {
        &self.recordings
    }

    /// The rig as it was when the session was recorded.
    pub fn rig(&self) -> Result<Rig, ReadError> {
        let recording =
            self.recordings.first().ok_or_else(|| ReadError("the session has no recording".to_owned()))?;
        parse_rig(&recording.header.rig_text)
            .map_err(|e| ReadError(format!("{}: the recorded rig file: {e}", recording.path.display())))
    }

    /// The frame of a camera at a trigger, with its identity; `Ok(Err(cause))` for a gap.
    pub fn recorded_frame(
        &self,
        camera: &CameraId,
        trigger: TriggerIndex,
    ) -> Result<Result<RecordedFrame, GapCause>, String> {
        let place = self.cameras.iter().position(|id| id == camera);
        let (r, c) = place.and_then(|place| self.places.get(place).copied()).ok_or_else(|| {
            let known: Vec<&str> = self.cameras.iter().map(CameraId::as_str).collect();
            format!("camera {camera} is not in the session; it has {}", known.join(", "))
        })?;
        self.recordings[r].frame(c, trigger)
    }
}

pub(crate) fn parse_rig(text: &str) -> Result<Rig, String> {
    let table: toml::Table = text.parse().map_err(|e: toml::de::Error| e.to_string())?;
    Rig::from_table(&table)
        .map_err(|problems| problems.iter().map(ToString::to_string).collect::<Vec<_>>().join("; "))
}

impl FrameSource for SessionReader {
    fn statement(&self) -> Option<SourceStatement> {
        let camera = |&(r, c): &(usize, usize)| {
            let header = &self.recordings[r].header.cameras[c];
            StatedCamera {
                id: header.id.clone(),
                width: header.width as usize,
                height: header.height as usize,
                device: header.device.clone(),
            }
        };
        let pattern = self.rig().ok().map(|rig| rig.pattern);
        Some(SourceStatement { cameras: self.places.iter().map(camera).collect(), pattern })
    }

    fn identity(&self) -> Result<SessionIdentity, String> {
        let first = &self.recordings.first().ok_or("the session has no recording")?.header;
        let ids = self.recordings.iter().map(|recording| &recording.header);
        if let Some(other) = ids.clone().find(|header| header.session_id != first.session_id) {
            return Err(format!(
                "the recordings are of two sessions, {} ({}) on node {} and {} ({}) on node {}; keep those of one together",
                first.session, first.session_id, first.node, other.session, other.session_id, other.node
            ));
        }
        let mut nodes: Vec<String> = ids.map(|header| header.node.to_string()).collect();
        nodes.sort();
        Ok(SessionIdentity {
            id: first.session_id.clone(),
            name: Some(first.session.to_string()),
            nodes,
            cameras: self.cameras.clone(),
        })
    }

    fn pixels_crc(&self, camera: &CameraId, trigger: TriggerIndex) -> Result<Option<u32>, String> {
        let place = self.cameras.iter().position(|id| id == camera);
        let place = place.and_then(|place| self.places.get(place));
        // What is not there is told where it is read.
        let Some(&(r, c)) = place else { return Ok(self.frame(camera, trigger)?.pixels_crc()) };
        Ok(self.recordings[r].frame_meta(c, trigger)?.ok().map(|meta| meta.pixels_crc))
    }

    fn cameras(&self) -> &[CameraId] {
        &self.cameras
    }

    fn triggers(&self) -> Range<u64> {
        self.triggers.clone()
    }

    fn frame(&self, camera: &CameraId, trigger: TriggerIndex) -> Result<Frame<'_>, String> {
        self.recorded_frame(camera, trigger).map(|outcome| match outcome {
            Ok(frame) => Frame::Owned(frame.image),
            Err(cause) => Frame::Gap(cause.to_string()),
        })
    }
}
