// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reads recordings: opens segments, knows the outcome of every trigger, checks every frame on access.

use super::belonging::{Belonging, Label};
use super::envelope::{FrameMeta, parse_envelope_of};
use super::frame_check::{check_pixels, identify, read_front};
use super::layout::{
    CameraHeader, ClockSample, GapCause, GapRecord, HEADER_METADATA, KEY_END_TRIGGER, KEY_FIRST_TRIGGER,
    KEY_JSON, KEY_RECORDS, MAX_TRIGGERS, NodeEvent, RecordingHeader, SEGMENT_METADATA, STATISTICS_METADATA,
    TriggerRecord, VERDICT_METADATA, VERSION, image_topic,
};
use super::metadata::{
    StatedHeader, foreign_reason, is_sound, of_most, parse_header, read_header, stated_index,
};
use super::scan::{End, Entries, Event, Walker, metadata_by_index, open_segment};
use super::segment_file::{BadRange, SegmentFile};
use super::session::RecordingFiles;
use super::statistics::WriteStatistics;
pub(crate) use super::topic::Topic;
use super::verdict::{CameraVerdict, TriggerSet, Verdict};
use crate::base::Fault;
use crate::base::ids::{CameraId, TriggerIndex};
use crate::base::image::Plane;
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::PathBuf;

/// Notes about one recording beyond this many are dropped: the first ones say what is wrong.
const MAX_PROBLEMS: usize = 1000;

/// Why a recording could not be opened at all.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ReadError {
    /// There is none where one was named: a mistake of whoever named it.
    #[error("{0}")]
    Absent(String),
    /// It is there and cannot be read, or is none of ours any more.
    #[error("{0}")]
    Unreadable(String),
}

/// A path without a recording is a mistake of usage, one that cannot be read is corrupt data.
impl From<ReadError> for Fault {
    fn from(error: ReadError) -> Self {
        match error {
            ReadError::Absent(_) => Self::usage(error),
            ReadError::Unreadable(_) => Self::corrupt(error),
        }
    }
}

/// Something about a segment's records that is not as it should be.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// The segment's number.
    pub segment: u32,
    /// The camera concerned.
    pub camera: Option<CameraId>,
    /// The trigger concerned.
    pub trigger: Option<TriggerIndex>,
    /// What was expected and found.
    pub message: String,
}

/// One segment.
pub struct SegmentReader {
    /// Its number.
    pub number: u32,
    /// Its file.
    pub path: PathBuf,
    /// No frame of an earlier trigger belongs to it.
    pub first_trigger: u64,
    /// No frame from this trigger on belongs to it; unknown in the last segment and after a crash.
    pub end_trigger: Option<u64>,
    /// How its records end.
    pub end: End,
    /// `None` where it cannot be opened; [`Self::end`] says why.
    pub(crate) file: Option<SegmentFile>,
}

impl SegmentReader {
    /// Whether it ends as a segment does that was closed.
    pub fn is_closed(&self) -> bool {
        self.end == End::Closed
    }

    /// Its length when it was opened, bytes.
    pub fn length(&self) -> usize {
        self.file.as_ref().map_or(0, SegmentFile::len)
    }

    /// What could not be read of it so far.
    pub fn bad_ranges(&self) -> Vec<BadRange> {
        self.file.as_ref().map(SegmentFile::bad_ranges).unwrap_or_default()
    }
}

/// How much of a recording to read when opening it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Extent {
    /// All small records.
    Everything,
    /// Outcomes, trigger table and verdict, by way of the indexes.
    Outcomes,
}

/// What a camera has at a trigger.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Outcome {
    /// A frame: place of the segment in the recording, and of the message in it.
    Frame { segment: usize, offset: usize, length: usize },
    /// A gap record.
    Gap(GapCause),
}

/// One node's recording.
pub struct RecordingReader {
    /// Its directory, or the single segment.
    pub path: PathBuf,
    /// What it says about itself.
    pub header: RecordingHeader,
    /// What its records have to say about their session.
    pub(crate) belonging: Belonging,
    /// In order.
    pub segments: Vec<SegmentReader>,
    /// The HSU's trigger table, by index.
    pub triggers: BTreeMap<TriggerIndex, TriggerRecord>,
    /// In the order of the file.
    pub clock_samples: Vec<ClockSample>,
    /// In the order of the file.
    pub events: Vec<NodeEvent>,
    /// The verdict as stored; `None` when the recording was not finished.
    pub verdict: Option<Verdict>,
    /// How the disk kept up, if the recording was finished.
    pub statistics: Option<WriteStatistics>,
    /// What was found wrong when opening.
    pub problems: Vec<Problem>,
    /// Per camera of the header.
    pub(crate) outcomes: Vec<BTreeMap<u64, Outcome>>,
    /// Numbers of the small records that are there, where they have numbers and were read.
    pub(super) numbers: TriggerSet,
    /// How many there were in all, if the recording was finished.
    pub(super) records: Option<u64>,
}

/// Triggers of a camera in a row that have gap records of the same cause.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GapRun {
    /// The triggers.
    pub triggers: std::ops::Range<u64>,
    /// Their cause.
    pub cause: GapCause,
}

/// A frame that passed its checks.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedFrame {
    /// Identity.
    pub meta: FrameMeta,
    /// Pixels.
    pub image: Plane<u8>,
}

impl RecordingReader {
    /// Per camera of the header: what is missing, run by run.
    pub fn gap_runs(&self) -> Vec<Vec<GapRun>> {
        let runs = |outcomes: &BTreeMap<u64, Outcome>| {
            let mut runs: Vec<GapRun> = Vec::new();
            for (&trigger, outcome) in outcomes {
                let Outcome::Gap(cause) = *outcome else { continue };
                match runs.last_mut().filter(|run| run.triggers.end == trigger && run.cause == cause) {
                    Some(run) => run.triggers.end += 1,
                    None => runs.push(GapRun { triggers: trigger..trigger + 1, cause }),
                }
            }
            runs
        };
        self.outcomes.iter().map(runs).collect()
    }

    /// Opens the segments and reads their small records. A segment that cannot be opened costs what is in it.
    pub(super) fn open(files: &RecordingFiles, what: Extent) -> Result<Self, ReadError> {
        let error = |message: String| ReadError::Unreadable(format!("{}: {message}", files.path.display()));
        if let Some(reason) = &files.unlisted {
            return Err(ReadError::Unreadable(reason.clone()));
        }
        let mut segments = Vec::new();
        for (number, path) in &files.segments {
            let (file, end) = match open_segment(path) {
                Ok(file) => (Some(file), End::Cut { at: 0 }),
                Err(reason) => (None, End::Damaged { at: 0, reason }),
            };
            let stated = match (&file, &end) {
                (None, End::Damaged { reason, .. }) => Err(format!("{}: {reason}", path.display())),
                (None, _) => Err(String::new()),
                (Some(file), _) => read_header(file),
            };
            let segment = SegmentReader {
                number: *number,
                path: path.clone(),
                first_trigger: 0,
                end_trigger: None,
                end,
                file,
            };
            segments.push((segment, stated));
        }
        let readable: Vec<&StatedHeader> =
            segments.iter().filter_map(|(_, stated)| stated.as_ref().ok()).collect();
        let Some(header) = of_most(&readable) else {
            return Err(error(match segments.first() {
                Some((segment, Err(reason))) if segment.file.is_none() => {
                    format!("no segment has a readable header ({reason})")
                }
                Some((_, Err(reason))) => {
                    format!(
                        "no segment has a readable header ({reason}); `fourdbody recover` saves what is whole"
                    )
                }
                _ => "no segments: nothing was recorded".to_owned(),
            }));
        };
        let versions = readable.iter().filter(|one| !one.is_foreign(&header)).map(|one| one.version);
        let version = versions.max().unwrap_or(VERSION);
        let mut recording = Self::empty(files.path.clone(), header, version);
        for (segment, stated) in segments {
            match stated {
                Ok(stated) if stated.is_foreign(&recording.header) => {
                    recording.problem(segment.number, None, None, foreign_reason(&stated.header));
                }
                _ => recording.add(segment, what),
            }
        }
        recording.leave_out_the_incredible();
        super::advice::advise(&mut recording);
        Ok(recording)
    }

    fn empty(path: PathBuf, header: RecordingHeader, version: u32) -> Self {
        Self {
            path,
            outcomes: vec![BTreeMap::new(); header.cameras.len()],
            belonging: Belonging::of(&header, version),
            numbers: TriggerSet::default(),
            records: None,
            header,
            segments: Vec::new(),
            triggers: BTreeMap::new(),
            clock_samples: Vec::new(),
            events: Vec::new(),
            verdict: None,
            statistics: None,
            problems: Vec::new(),
        }
    }

    pub(super) fn problem(
        &mut self,
        segment: u32,
        camera: Option<usize>,
        trigger: Option<u64>,
        message: impl Into<String>,
    ) {
        if self.problems.len() < MAX_PROBLEMS {
            let camera = camera.and_then(|c| self.header.cameras.get(c)).map(|c| c.id.clone());
            let trigger = trigger.map(TriggerIndex);
            self.problems.push(Problem { segment, camera, trigger, message: message.into() });
        }
    }

    fn add(&mut self, mut segment: SegmentReader, what: Extent) {
        let number = segment.number;
        let expected = self.segments.last().map_or(number, |last| last.number.saturating_add(1));
        if self.segments.last().is_some_and(|last| last.number == number) {
            self.problem(number, None, None, "two files have this segment's number");
        } else if number != expected {
            self.problem(number, None, None, format!("expected segment {expected} here: it is missing"));
        }
        if let Some(file) = segment.file.take() {
            if what == Extent::Everything || !self.take_index(&mut segment, &file) {
                self.walk(&mut segment, &file);
            }
            segment.file = Some(file);
        }
        self.segments.push(segment);
    }

    fn walk(&mut self, segment: &mut SegmentReader, file: &SegmentFile) {
        let (place, number) = (self.segments.len(), segment.number);
        let topics: Vec<String> = self.header.cameras.iter().map(|c| image_topic(&c.id)).collect();
        let mut channels: BTreeMap<u16, Topic> = BTreeMap::new();
        let mut walker = Walker::new(file);
        let mut payload = Vec::new();
        loop {
            for event in walker.by_ref() {
                match event {
                    Event::Channel { id, topic } => {
                        channels.insert(id, Topic::of(&topic, &topics));
                    }
                    Event::Message { channel, sequence, data } => {
                        let topic = channels.get(&channel).copied().unwrap_or(Topic::Other);
                        if let Topic::Image(camera) = topic {
                            let outcome =
                                Outcome::Frame { segment: place, offset: data.start, length: data.len() };
                            self.outcome(number, camera, u64::from(sequence), outcome);
                        } else if topic != Topic::Other {
                            payload.resize(data.len(), 0);
                            // What cannot be read is told of the segment as a whole.
                            if file.read(data.start, &mut payload).is_ok() {
                                self.small_record(number, topic, &payload);
                            }
                        }
                    }
                    Event::Metadata { name, entries } => self.metadata(segment, &name, &entries),
                    Event::DataEnd { .. } | Event::Footer { .. } | Event::Chunk { .. } => {}
                }
            }
            if !walker.go_on() {
                break;
            }
        }
        segment.end = walker.end();
    }

    /// The outcomes of a closed segment from its index; `false` when there is none to rely on.
    fn take_index(&mut self, segment: &mut SegmentReader, file: &SegmentFile) -> bool {
        let Some(metadata) = metadata_by_index(file) else { return false };
        let Some(index) = stated_index(file, &metadata) else { return false };
        for (name, entries) in &metadata {
            self.metadata(segment, name, entries);
        }
        let (place, number) = (self.segments.len(), segment.number);
        for (camera, trigger, offset, length) in index.frames {
            let (Ok(offset), Ok(length)) = (usize::try_from(offset), usize::try_from(length)) else {
                continue;
            };
            self.outcome(number, camera as usize, trigger, Outcome::Frame { segment: place, offset, length });
        }
        index.gaps.iter().for_each(|gap| self.gap(number, gap));
        let rows = index.triggers.into_iter().flatten().map(TriggerRecord::of_row);
        rows.for_each(|row| self.trigger(number, row));
        segment.end = End::Closed;
        true
    }

    fn trigger(&mut self, segment: u32, record: TriggerRecord) {
        if record.index.0 >= MAX_TRIGGERS {
            let message =
                format!("a row of the trigger table: no session has more than {MAX_TRIGGERS} triggers");
            self.problem(segment, None, Some(record.index.0), message);
        } else if self.triggers.insert(record.index, record).is_some_and(|first| first != record) {
            let message = "two different rows in the trigger table";
            self.problem(segment, None, Some(record.index.0), message);
        }
    }

    fn gap(&mut self, segment: u32, gap: &GapRecord) {
        match self.header.cameras.iter().position(|c| c.id == gap.camera) {
            Some(camera) => self.outcome(segment, camera, gap.trigger.0, Outcome::Gap(gap.cause)),
            None => {
                let message = format!("a gap record of camera {}, which is not recorded", gap.camera);
                self.problem(segment, None, Some(gap.trigger.0), message);
            }
        }
    }

    fn outcome(&mut self, segment: u32, camera: usize, trigger: u64, outcome: Outcome) {
        if trigger >= MAX_TRIGGERS {
            let message = format!("no session has more than {MAX_TRIGGERS} triggers");
            self.problem(segment, Some(camera), Some(trigger), message);
            return;
        }
        let Some(outcomes) = self.outcomes.get_mut(camera) else { return };
        if let Some(first) = outcomes.get(&trigger) {
            let message = format!("two outcomes, expected one: {first:?} and {outcome:?}");
            self.problem(segment, Some(camera), Some(trigger), message);
            return;
        }
        outcomes.insert(trigger, outcome);
    }

    fn small_record(&mut self, segment: u32, topic: Topic, bytes: &[u8]) {
        let label = Label::of(bytes);
        if let Err(reason) = self.belonging.check(label.session) {
            return self.problem(segment, None, None, format!("{topic:?}: {reason}"));
        }
        if let Some(number) = label.number {
            self.numbers.insert(number);
        }
        let result = match topic {
            Topic::Gaps => serde_json::from_slice(bytes).map(|gap| self.gap(segment, &gap)),
            Topic::Triggers => serde_json::from_slice(bytes).map(|record| self.trigger(segment, record)),
            Topic::Clock => serde_json::from_slice(bytes).map(|sample| self.clock_samples.push(sample)),
            Topic::Events => serde_json::from_slice(bytes).map(|event| self.events.push(event)),
            Topic::Image(_) | Topic::Other => Ok(()),
        };
        if let Err(error) = result {
            self.problem(segment, None, None, format!("a record of {topic:?} is not readable: {error}"));
        }
    }

    fn metadata(&mut self, segment: &mut SegmentReader, name: &str, entries: &Entries) {
        let session = Label::of_entries(entries).session;
        let marked = [SEGMENT_METADATA, STATISTICS_METADATA, VERDICT_METADATA].contains(&name);
        if let Err(reason) = self.belonging.check(session)
            && marked
        {
            return self.problem(segment.number, None, None, format!("{name}: {reason}"));
        }
        let number = |key| entries.get(key).and_then(|text: &String| text.parse::<u64>().ok());
        if is_sound(entries) == Some(false) {
            self.problem(
                segment.number,
                None,
                None,
                format!("its metadata record {name} fails its checksum"),
            );
        }
        match name {
            HEADER_METADATA => match parse_header(entries) {
                Ok(stated) => {
                    segment.first_trigger = number(KEY_FIRST_TRIGGER).unwrap_or(0);
                    self.check_names(segment, entries, &stated.header);
                    if stated.number != segment.number {
                        let message = format!("the file says that it is segment {}", stated.number);
                        self.problem(segment.number, None, None, message);
                    }
                    if stated.header != self.header {
                        let message = "its header differs from that of the other segments";
                        self.problem(segment.number, None, None, message);
                    }
                }
                Err(message) => self.problem(segment.number, None, None, message),
            },
            SEGMENT_METADATA => segment.end_trigger = number(KEY_END_TRIGGER),
            // Of a kind that is nice to have: one that is not readable is no problem.
            STATISTICS_METADATA => {
                let json = entries.get(KEY_JSON).map(String::as_str).unwrap_or_default();
                self.statistics = serde_json::from_str(json).ok();
            }
            VERDICT_METADATA => {
                let json = entries.get(KEY_JSON).map(String::as_str).unwrap_or_default();
                match serde_json::from_str(json) {
                    Ok(verdict) => {
                        self.records = number(KEY_RECORDS);
                        self.verdict = Some(verdict);
                    }
                    Err(error) => {
                        let message = format!("the stored verdict is not readable: {error}");
                        self.problem(segment.number, None, None, message);
                    }
                }
            }
            _ => {}
        }
    }

    /// The frame of a camera (its place in the header) at a trigger, checked; `Ok(Err(cause))` for a gap. An error names the
    /// camera and the trigger.
    pub fn frame(
        &self,
        camera: usize,
        trigger: TriggerIndex,
    ) -> Result<Result<RecordedFrame, GapCause>, String> {
        self.outcome_at(camera, trigger, |file, place| self.read_frame(file, place, camera, trigger))
    }

    /// The identity of a camera's frame (its place in the header) at a trigger, without a look at its pixels; `Ok(Err(cause))`
    /// for a gap.
    pub fn frame_meta(
        &self,
        camera: usize,
        trigger: TriggerIndex,
    ) -> Result<Result<FrameMeta, GapCause>, String> {
        self.outcome_at(camera, trigger, |file, place| {
            let front = read_front(file, &place)?;
            let (envelope, _) = parse_envelope_of(&front).map_err(|e| e.to_string())?;
            self.belonging.check(envelope.session)?;
            Ok(envelope.meta)
        })
    }

    /// What a camera has at a trigger; of a frame what `read` makes of its message.
    fn outcome_at<T>(
        &self,
        camera: usize,
        trigger: TriggerIndex,
        read: impl FnOnce(&SegmentFile, Range<usize>) -> Result<T, String>,
    ) -> Result<Result<T, GapCause>, String> {
        let described = self.header.cameras.get(camera).ok_or("no such camera in the recording")?;
        let place = || format!("{}: camera {} trigger {trigger}", self.path.display(), described.id);
        let outcome = self.outcomes.get(camera).and_then(|outcomes| outcomes.get(&trigger.0));
        match outcome {
            None if self.ended_unknowing() && trigger.0 >= self.triggers_end() => Ok(Err(GapCause::Aborted)),
            None => Err(format!(
                "{}: neither a frame nor a gap record; the recording was cut or not finished: run `fourdbody verify`",
                place()
            )),
            Some(Outcome::Gap(cause)) => Ok(Err(*cause)),
            Some(&Outcome::Frame { segment, offset, length }) => {
                let file = self.segments.get(segment).and_then(|segment| segment.file.as_ref());
                let message = offset.checked_add(length).map(|end| offset..end);
                let inside = file.zip(message).filter(|(file, message)| message.end <= file.len());
                let (file, message) = inside.ok_or_else(|| format!("{}: outside of its file", place()))?;
                read(file, message)
                    .map(Ok)
                    .map_err(|reason| format!("{}: {reason}; run `fourdbody verify`", place()))
            }
        }
    }

    fn read_frame(
        &self,
        file: &SegmentFile,
        message: Range<usize>,
        camera: usize,
        trigger: TriggerIndex,
    ) -> Result<RecordedFrame, String> {
        let front = read_front(file, &message)?;
        let (meta, pixels) =
            identify(&front, message.len(), (camera, trigger), &self.header, &self.belonging)?;
        let mut data = vec![0; pixels.len()];
        file.read(message.start + pixels.start, &mut data).map_err(|bad| bad.to_string())?;
        check_pixels(&data, &meta)?;
        let image = Plane::from_vec(meta.width as usize, meta.height as usize, data);
        Ok(RecordedFrame { meta, image: image.ok_or("pixels do not fill the frame")? })
    }

    /// Outcomes of each camera, counted from the records.
    pub fn counted(&self) -> Vec<CameraVerdict> {
        let count = |(camera, outcomes): (&CameraHeader, &BTreeMap<u64, Outcome>)| {
            let mut counted = CameraVerdict { camera: camera.id.clone(), frames: 0, gaps: BTreeMap::new() };
            for outcome in outcomes.values() {
                match outcome {
                    Outcome::Frame { .. } => counted.frames += 1,
                    Outcome::Gap(cause) => *counted.gaps.entry(*cause).or_default() += 1,
                }
            }
            counted
        };
        self.header.cameras.iter().zip(&self.outcomes).map(count).collect()
    }

    /// How many small records there were, as far as is known.
    pub(super) fn numbered(&self) -> u64 {
        self.records.unwrap_or(0).max(self.numbers.end())
    }

    /// One more than the highest trigger in the records.
    pub(crate) fn known_end(&self) -> u64 {
        let outcomes =
            self.outcomes.iter().filter_map(|o| o.last_key_value()).map(|(trigger, _)| trigger + 1);
        let table = self.triggers.last_key_value().map(|(index, _)| index.0.saturating_add(1));
        outcomes.chain(table).max().unwrap_or(0).min(MAX_TRIGGERS)
    }

    /// Triggers of the session, as far as this recording knows.
    pub fn triggers_end(&self) -> u64 {
        let stated = self.verdict.as_ref().map_or(0, |verdict| verdict.triggers);
        self.known_end().max(stated.min(MAX_TRIGGERS))
    }

    /// Whether it was broken off, as its verdict says, and never learned how many triggers the HSU emitted: the session may
    /// have more than it has outcomes for.
    fn ended_unknowing(&self) -> bool {
        self.verdict
            .as_ref()
            .is_some_and(|verdict| verdict.aborted.is_some() && verdict.triggers_emitted.is_none())
    }
}
