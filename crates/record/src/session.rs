// SPDX-License-Identifier: MIT OR Apache-2.0
//! A session: a directory with the recordings of all its nodes, read as one source of frames.

use super::layout::{GapCause, MAX_CAMERAS, VERDICT_METADATA, segment_number};
use super::reader::{Extent, ReadError, RecordedFrame, RecordingReader};
use super::scan::metadata_by_index;
use super::segment_file::SegmentFile;
use super::trigger_times::TriggerTimes;
use crate::base::ids::{CameraId, NodeId, TriggerIndex};
use crate::config::Rig;
use crate::data::{Frame, FrameSource, LostPart, SessionIdentity, SourceStatement, StatedCamera};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt;
use std::io::ErrorKind;
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
pub(super) fn find(path: &Path) -> Result<Vec<RecordingFiles>, ReadError> {
    let shown = path.display();
    let expected =
        "expected a session (node-*/segment-*.mcap), a recording (segment-*.mcap) or an .mcap file";
    let kind = std::fs::metadata(path).map_err(|e| {
        let message = format!("{shown}: {e}; {expected}");
        match e.kind() {
            ErrorKind::NotFound | ErrorKind::NotADirectory => ReadError::Absent(message),
            _ => ReadError::Unreadable(message),
        }
    })?;
    if kind.is_file() {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        let segments = vec![(segment_number(name).unwrap_or(0), path.to_owned())];
        return Ok(vec![RecordingFiles::of(path, segments)]);
    }
    let own = segments(path).map_err(ReadError::Unreadable)?;
    if !own.is_empty() {
        return Ok(vec![RecordingFiles::of(path, own)]);
    }
    let mut recordings = Vec::new();
    for (name, entry) in entries(path).map_err(ReadError::Unreadable)? {
        if !name.starts_with("node-") {
            continue;
        }
        // One that cannot be listed does not hide the others; a link whose disk is away is not nothing.
        let listed = match std::fs::metadata(&entry) {
            Ok(kind) if !kind.is_dir() => continue,
            Ok(_) => segments(&entry),
            Err(error) => Err(format!("{}: {error}", entry.display())),
        };
        let (segments, unlisted) = match listed {
            Ok(segments) => (segments, None),
            Err(reason) => (Vec::new(), Some(reason)),
        };
        recordings.push(RecordingFiles { path: entry, segments, unlisted });
    }
    if recordings.is_empty() {
        return Err(ReadError::Absent(format!("{shown}: nothing recorded here; {expected}")));
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

impl Unreadable {
    /// What to call it: its node, or its path where that says nothing.
    pub fn name(&self) -> String {
        if self.node.is_empty() { self.path.display().to_string() } else { format!("node {}", self.node) }
    }
}

impl fmt::Display for Unreadable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: its recording cannot be read: {}", self.name(), self.reason)
    }
}

/// The recordings at `path` (a session, a recording or a segment) that can be read, with all small records; and those that
/// cannot, which do not hide the others.
pub fn open_each(path: &Path) -> Result<(Vec<RecordingReader>, Vec<Unreadable>), ReadError> {
    open_extent(path, Extent::Everything)
}

fn open_extent(path: &Path, what: Extent) -> Result<(Vec<RecordingReader>, Vec<Unreadable>), ReadError> {
    let (mut readable, mut unreadable) = (Vec::new(), Vec::new());
    for files in find(path)? {
        match RecordingReader::open(&files, what) {
            Ok(recording) => readable.push(recording),
            Err(error) => {
                let node = node_of_dir(&files.path).unwrap_or_default();
                unreadable.push(Unreadable { path: files.path, node, reason: error.to_string() });
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
    /// Recordings that cannot be read, in the order of `lost`.
    unreadable: Vec<Unreadable>,
    /// What the session lacks for that.
    lost: Vec<LostPart>,
    /// Those of recordings that cannot be read included, as far as the rig names them.
    cameras: Vec<CameraId>,
    /// Where the frames of each of `cameras` are.
    places: Vec<Place>,
    triggers: Range<u64>,
    times: Option<TriggerTimes>,
}

/// Where a camera's frames are.
#[derive(Debug, Clone, Copy)]
enum Place {
    /// Recording, and place in its header.
    Recorded(usize, usize),
    /// In the recording with this number among those that cannot be read.
    Lost(usize),
}

impl SessionReader {
    /// Opens a session's directory, one recording's directory, or one segment, and reads all small records. A recording that
    /// cannot be read does not hide the others, see [`Self::unreadable`]; an error where there is none that can.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        Self::of(path, open_extent(path, Extent::Everything)?)
    }

    /// As [`Self::open`], but reads closed segments by their indexes only: much faster from a cold disk. Clock samples and
    /// events stay empty; so do trigger tables of versions that have none in their indexes.
    pub fn open_frames(path: &Path) -> Result<Self, ReadError> {
        Self::of(path, open_extent(path, Extent::Outcomes)?)
    }

    /// As [`Self::open_frames`], with trigger tables whatever version has written them.
    pub fn open_timed(path: &Path) -> Result<Self, ReadError> {
        let session = Self::open_frames(path)?;
        let untimed =
            |recording: &RecordingReader| recording.header.hsu.is_some() && recording.triggers.is_empty();
        if session.recordings.iter().any(untimed) { Self::open(path) } else { Ok(session) }
    }

    fn of(
        path: &Path,
        (recordings, unreadable): (Vec<RecordingReader>, Vec<Unreadable>),
    ) -> Result<Self, ReadError> {
        if recordings.is_empty() {
            let reasons: Vec<&str> = unreadable.iter().map(|one| one.reason.as_str()).collect();
            let nothing = || format!("{}: nothing recorded here", path.display());
            let told = if reasons.is_empty() { nothing() } else { reasons.join("\n") };
            return Err(ReadError::Unreadable(told));
        }
        let mut placed: Vec<(CameraId, Place)> = Vec::new();
        for (r, recording) in recordings.iter().enumerate() {
            let own = recording.header.cameras.iter().enumerate();
            placed.extend(own.map(|(c, camera)| (camera.id.clone(), Place::Recorded(r, c))));
        }
        let rig = recordings.iter().find_map(|recording| parse_rig(&recording.header.rig_text).ok());
        let mut lost: Vec<LostPart> = unreadable.iter().map(lost_part).collect();
        if let Some(rig) = rig {
            for (number, (part, one)) in lost.iter_mut().zip(&unreadable).enumerate() {
                let own = rig.cameras().filter(|(_, camera)| camera.node.as_str() == one.node);
                let own = own.take(MAX_CAMERAS).map(|(_, camera)| camera.id.clone());
                part.cameras = own.filter(|id| placed.iter().all(|(known, _)| known != id)).collect();
                placed.extend(part.cameras.iter().map(|id| (id.clone(), Place::Lost(number))));
            }
            let order: BTreeMap<&CameraId, usize> =
                rig.cameras().enumerate().map(|(place, (_, camera))| (&camera.id, place)).collect();
            placed.sort_by_key(|(id, _)| order.get(id).copied().unwrap_or(usize::MAX));
        }
        let start =
            recordings.iter().filter_map(|r| r.segments.first()).map(|segment| segment.first_trigger).min();
        let end = recordings.iter().map(RecordingReader::triggers_end).max().unwrap_or(0);
        let triggers = start.unwrap_or(0).min(end)..end;
        let (cameras, places) = placed.into_iter().unzip();
        let times = TriggerTimes::of(&recordings);
        Ok(Self { recordings, unreadable, lost, cameras, places, triggers, times })
    }

    /// The recordings, by node.
    pub fn recordings(&self) -> &[RecordingReader] {
        &self.recordings
    }

    /// Recordings of the session of which nothing can be read: it is not whole.
    pub fn unreadable(&self) -> &[Unreadable] {
        &self.unreadable
    }

    /// The rig as it was when the session was recorded.
    pub fn rig(&self) -> Result<Rig, ReadError> {
        let none = || ReadError::Unreadable("the session has no recording".to_owned());
        let recording = self.recordings.first().ok_or_else(none)?;
        parse_rig(&recording.header.rig_text).map_err(|e| {
            ReadError::Unreadable(format!("{}: the recorded rig file: {e}", recording.path.display()))
        })
    }

    /// Recording of a camera's frames, and its place in the header.
    fn place(&self, camera: &CameraId) -> Result<(&RecordingReader, usize), String> {
        let known = self.cameras.iter().position(|id| id == camera);
        match known.and_then(|known| self.places.get(known)) {
            Some(&Place::Recorded(r, c)) => Ok((&self.recordings[r], c)),
            Some(&Place::Lost(number)) => Err(format!("camera {camera}: {}", self.lost[number])),
            None => {
                let known: Vec<&str> = self.cameras.iter().map(CameraId::as_str).collect();
                Err(format!("camera {camera} is not in the session; it has {}", known.join(", ")))
            }
        }
    }

    /// The frame of a camera at a trigger, with its identity; `Ok(Err(cause))` for a gap.
    pub fn recorded_frame(
        &self,
        camera: &CameraId,
        trigger: TriggerIndex,
    ) -> Result<Result<RecordedFrame, GapCause>, String> {
        let (recording, place) = self.place(camera)?;
        recording.frame(place, trigger)
    }
}

pub(crate) fn parse_rig(text: &str) -> Result<Rig, String> {
    let table: toml::Table = text.parse().map_err(|e: toml::de::Error| e.to_string())?;
    Rig::from_table(&table)
        .map_err(|problems| problems.iter().map(ToString::to_string).collect::<Vec<_>>().join("; "))
}

/// A recording that cannot be read; its cameras are not known yet.
fn lost_part(one: &Unreadable) -> LostPart {
    LostPart { reason: one.to_string(), cameras: Vec::new() }
}

impl FrameSource for SessionReader {
    fn statement(&self) -> Option<SourceStatement> {
        let camera = |place: &Place| {
            let Place::Recorded(r, c) = *place else { return None };
            let header = &self.recordings[r].header.cameras[c];
            Some(StatedCamera {
                id: header.id.clone(),
                width: header.width as usize,
                height: header.height as usize,
                device: header.device.clone(),
            })
        };
        let pattern = self.rig().ok().map(|rig| rig.pattern);
        Some(SourceStatement { cameras: self.places.iter().filter_map(camera).collect(), pattern })
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

    fn recorded_ns(&self) -> Option<u64> {
        self.recordings.iter().map(|recording| recording.header.created_ns).min()
    }

    fn pixels_crc(&self, camera: &CameraId, trigger: TriggerIndex) -> Result<Option<u32>, String> {
        let (recording, place) = self.place(camera)?;
        Ok(recording.frame_meta(place, trigger)?.ok().map(|meta| meta.pixels_crc))
    }

    fn trigger_time_ns(&self, trigger: TriggerIndex) -> Option<u64> {
        self.times.as_ref()?.at(&self.recordings, trigger)
    }

    fn time_base(&self) -> Option<String> {
        self.times.as_ref().map(|times| times.name(&self.recordings))
    }

    fn lost(&self) -> &[LostPart] {
        &self.lost
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
