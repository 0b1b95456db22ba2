// SPDX-License-Identifier: MIT OR Apache-2.0
//! A session: a directory with the recordings of all its nodes, read as one source of frames.

use super::envelope::FrameMeta;
use super::files::{ReadError, find, node_of_dir};
use super::layout::{GapCause, MAX_CAMERAS};
use super::reader::{Extent, RecordedFrame, RecordingReader};
use super::trigger_times::TriggerTimes;
use crate::base::ids::{CameraId, TriggerIndex};
use crate::config::Rig;
use crate::data::{Frame, FrameSource, LostPart, SessionIdentity, SourceStatement, StatedCamera};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// A recording of which nothing can be read.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Unreadable {
    /// Its directory, or the single segment.
    pub path: PathBuf,
    /// The node, by the directory's name; empty where that names none.
    pub node: String,
    /// What was expected and found.
    pub reason: String,
}

impl Unreadable {
    /// The name that messages use: its node, or its path where the node is not known.
    pub fn name(&self) -> String {
        if self.node.is_empty() { self.path.display().to_string() } else { format!("node {}", self.node) }
    }
}

impl fmt::Display for Unreadable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: its recording cannot be read: {}", self.name(), self.reason)
    }
}

/// The recordings at `path` (a session, a recording or a segment) that can be read, with all small records; and those
/// that cannot, which do not hide the others. An error where there is none that can.
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
    if readable.is_empty() {
        let reasons: Vec<&str> = unreadable.iter().map(|one| one.reason.as_str()).collect();
        return Err(ReadError::Unreadable(reasons.join("\n")));
    }
    Ok((readable, unreadable))
}

/// A session: the recordings of all its nodes, read as one source of frames.
///
/// Whoever reconstructs, exports or shows a session opens one, and shares it between threads. It promises a frame that
/// passed all its checks, or the cause of a gap, for every camera and trigger. It never writes.
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
    times: TriggerTimes,
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
    /// Opens a session's directory, one recording's directory, or one segment, and reads all small records. A recording
    /// that cannot be read does not hide the others, see [`Self::unreadable`]; an error where there is none that can.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        open_extent(path, Extent::Everything).map(Self::of)
    }

    /// As [`Self::open`], but reads closed segments by their indexes only: much faster from a cold disk. Clock samples
    /// and events stay empty; so do trigger tables of versions that have none in their indexes.
    pub fn open_frames(path: &Path) -> Result<Self, ReadError> {
        open_extent(path, Extent::Outcomes).map(Self::of)
    }

    /// As [`Self::open_frames`], with trigger tables whatever version has written them.
    pub fn open_timed(path: &Path) -> Result<Self, ReadError> {
        let session = Self::open_frames(path)?;
        let untimed =
            |recording: &RecordingReader| recording.header.hsu.is_some() && recording.triggers.is_empty();
        if session.recordings.iter().any(untimed) { Self::open(path) } else { Ok(session) }
    }

    fn of((recordings, unreadable): (Vec<RecordingReader>, Vec<Unreadable>)) -> Self {
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
        Self { recordings, unreadable, lost, cameras, places, triggers, times }
    }

    /// The recordings that can be read, in the order of the nodes' names.
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

    /// The identity of a camera's frame at a trigger, without its pixels; `Ok(Err(cause))` for a gap.
    pub fn recorded_frame_meta(
        &self,
        camera: &CameraId,
        trigger: TriggerIndex,
    ) -> Result<Result<FrameMeta, GapCause>, String> {
        let (recording, place) = self.place(camera)?;
        recording.frame_meta(place, trigger)
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
                "the recordings are of two sessions, {} ({}) on node {} and {} ({}) on node {}; keep those of one \
                 together",
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
        self.times.at(&self.recordings, trigger)
    }

    fn time_base(&self) -> Option<String> {
        Some(self.times.name(&self.recordings))
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
