//! One recording's segments together: which header to believe, one outcome for each camera and trigger, and how
//! the session ended.

use super::salvage::{SegmentScan, scan};
use super::{Damage, RecoverError, header};
use crate::ids::TriggerIndex;
use crate::record::layout::{
    ClockSample, GapCause, MAX_TRIGGERS, NodeEvent, RecordingHeader, TriggerRecord, segment_name,
};
use crate::record::metadata::foreign_reason;
use crate::record::reader::Outcome;
use crate::record::segment_file::SegmentFile;
use crate::record::session::RecordingFiles;
use crate::record::statistics::WriteStatistics;
use crate::record::verdict::Verdict;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

/// What is left of one node's recording.
pub struct Salvage {
    /// Its directory, or the single segment.
    pub path: PathBuf,
    /// What it says about itself.
    pub header: RecordingHeader,
    /// Whether the header was not readable and had to be made anew.
    pub rebuilt: bool,
    /// Whether a checksum proves the header.
    pub proven: bool,
    /// The segments, in order; `None` where one cannot be opened.
    pub files: Vec<Option<SegmentFile>>,
    /// Per camera of the header.
    pub outcomes: Vec<BTreeMap<u64, Outcome>>,
    /// Per camera of the header: frames whose identity is known and whose pixels are damaged.
    pub damaged: Vec<BTreeSet<u64>>,
    /// The trigger table.
    pub triggers: BTreeMap<u64, TriggerRecord>,
    /// In the order of the files.
    pub clock_samples: Vec<ClockSample>,
    /// In the order of the files.
    pub events: Vec<NodeEvent>,
    /// The stored verdict, if it may be believed.
    pub verdict: Option<Verdict>,
    /// How the disk kept up with the original.
    pub statistics: Option<WriteStatistics>,
    /// First trigger of a single segment, 0 for a recording.
    pub first_trigger: u64,
    /// Whether this is one segment of a recording that had more.
    pub fragment: bool,
    /// What was found wrong.
    pub damage: Vec<Damage>,
    /// Small records that were there, but under no checksum that is right.
    pub records_lost: u64,
}

/// Opens and scans all segments. One that cannot be opened costs what is in it.
pub fn salvage(files: &RecordingFiles, advance: &(dyn Fn(u64) + Sync)) -> Result<Salvage, RecoverError> {
    let unusable = |reason: String| RecoverError::Unusable { path: files.path.clone(), reason };
    if let Some(reason) = &files.unlisted {
        return Err(unusable(reason.clone()));
    }
    let (mut opened, mut closed_to_us) = (Vec::new(), Vec::new());
    for (number, path) in &files.segments {
        match SegmentFile::open(path) {
            Ok(file) => opened.push(Some(file)),
            Err(error) => {
                closed_to_us.push((*number, format!("{} cannot be opened: {error}", segment_name(*number))));
                opened.push(None);
            }
        }
    }
    if let Some((_, reason)) = closed_to_us.first().filter(|_| closed_to_us.len() == opened.len()) {
        return Err(unusable(reason.clone()));
    }
    let numbered: Vec<(u32, &Option<SegmentFile>)> =
        files.segments.iter().zip(&opened).map(|((number, _), file)| (*number, file)).collect();
    let scans: Vec<SegmentScan> = numbered
        .par_iter()
        .map(|(number, file)| file.as_ref().map(|file| scan(*number, file, advance)).unwrap_or_default())
        .collect();
    let stated = header::readable(&scans);
    let rebuilt = stated.is_none();
    let (header, proven) = stated
        .or_else(|| header::rebuilt(&files.path, &scans).map(|header| (header, false)))
        .ok_or_else(|| unusable("no segment has a readable header or a whole frame".to_owned()))?;
    let single = files.path.is_file();
    let mut salvage = Salvage {
        path: files.path.clone(),
        outcomes: vec![BTreeMap::new(); header.cameras.len()],
        damaged: vec![BTreeSet::new(); header.cameras.len()],
        header,
        rebuilt,
        proven,
        triggers: BTreeMap::new(),
        clock_samples: Vec::new(),
        events: Vec::new(),
        verdict: None,
        statistics: None,
        first_trigger: scans.first().and_then(|scan| scan.first_trigger).filter(|_| single).unwrap_or(0),
        fragment: single && scans.first().is_some_and(|scan| scan.end_trigger.is_some()),
        damage: Vec::new(),
        records_lost: 0,
        files: opened,
    };
    if rebuilt {
        salvage.note(0, "no segment has a readable header: made anew from the frames");
    }
    salvage.note_missing_segments(files, single);
    closed_to_us.into_iter().for_each(|(number, reason)| salvage.note(number, reason));
    let numbers: Vec<u32> = files.segments.iter().map(|(number, _)| *number).collect();
    let closed: Vec<bool> = scans.iter().map(|scan| scan.closed).collect();
    for (place, scan) in scans.into_iter().enumerate() {
        let foreign = scan.header.as_ref().filter(|stated| stated.is_foreign(&salvage.header));
        match foreign.map(|stated| foreign_reason(&stated.header)) {
            Some(reason) => salvage.note(numbers[place], reason),
            None => salvage.take(place, scan),
        }
    }
    salvage.note_cut_segments(&numbers, &closed);
    Ok(salvage)
}

impl Salvage {
    fn note(&mut self, segment: u32, reason: impl Into<String>) {
        self.damage.push(Damage { segment, from: 0, to: 0, reason: reason.into() });
    }

    fn note_missing_segments(&mut self, files: &RecordingFiles, single: bool) {
        let mut expected = if single { files.segments.first().map_or(0, |(number, _)| *number) } else { 0 };
        for (number, _) in &files.segments {
            if *number > expected {
                self.note(expected, format!("{} is missing", segment_name(expected)));
            }
            expected = number.saturating_add(1);
        }
    }

    /// A crash leaves the last segments open. One that a closed one follows was cut later, unless the disk had
    /// refused it: then an event says so.
    fn note_cut_segments(&mut self, numbers: &[u32], closed: &[bool]) {
        let finished = if self.verdict.is_some() { closed.len() } else { 0 };
        let last_closed = closed.iter().rposition(|closed| *closed).unwrap_or(0);
        for (place, number) in numbers.iter().enumerate().take(finished.max(last_closed)) {
            let opened = self.files[place].is_some();
            if opened && !closed[place] && !self.events.iter().any(|event| event.gives_up(*number)) {
                self.note(*number, format!("{} was closed, but is cut", segment_name(*number)));
            }
        }
    }

    fn take(&mut self, place: usize, scan: SegmentScan) {
        self.damage.extend(scan.damage);
        self.records_lost += scan.records_lost;
        let camera_of: Vec<Option<usize>> = scan
            .cameras
            .iter()
            .map(|(name, width, height)| {
                self.header.cameras.iter().position(|camera| {
                    (camera.id.as_str(), camera.width, camera.height) == (name.as_str(), *width, *height)
                })
            })
            .collect();
        for frame in scan.frames {
            let Some(camera) = camera_of[frame.camera].filter(|_| frame.trigger < MAX_TRIGGERS) else {
                continue;
            };
            let (offset, length) = (frame.message.start, frame.message.len());
            let outcome = Outcome::Frame { segment: place, offset, length };
            let known = self.outcomes[camera].entry(frame.trigger).or_insert(outcome);
            if matches!(known, Outcome::Gap(_)) {
                *known = outcome;
            }
        }
        for (camera, trigger) in scan.damaged_frames {
            if let Some(camera) = camera_of[camera].filter(|_| trigger < MAX_TRIGGERS) {
                self.damaged[camera].insert(trigger);
            }
        }
        for gap in scan.gaps {
            let camera = self.header.cameras.iter().position(|camera| camera.id == gap.camera);
            if let Some(camera) = camera.filter(|_| gap.trigger.0 < MAX_TRIGGERS) {
                self.outcomes[camera].entry(gap.trigger.0).or_insert(Outcome::Gap(gap.cause));
            }
        }
        for row in scan.triggers.into_iter().filter(|row| row.index.0 < MAX_TRIGGERS) {
            self.triggers.entry(row.index.0).or_insert(row);
        }
        self.clock_samples.extend(scan.clock_samples);
        self.events.extend(scan.events);
        if let Some(verdict) =
            scan.verdict.filter(|verdict| scan.proven || scan.verdict_proven || self.agrees(verdict))
        {
            self.verdict = Some(verdict);
        }
        self.statistics = scan.statistics.or(self.statistics);
    }

    /// Whether a verdict that no checksum proves agrees with itself and with the header.
    fn agrees(&self, verdict: &Verdict) -> bool {
        let named = verdict.cameras.iter().map(|camera| &camera.camera);
        let whole = |frames: u64, mut gaps: std::collections::btree_map::Values<'_, GapCause, u64>| {
            gaps.try_fold(frames, |sum, gaps| sum.checked_add(*gaps)) == Some(verdict.triggers)
        };
        named.eq(self.header.cameras.iter().map(|camera| &camera.id))
            && verdict.triggers <= MAX_TRIGGERS
            && verdict.triggers >= self.known_end()
            && verdict.cameras.iter().all(|camera| whole(camera.frames, camera.gaps.values()))
            && (self.rebuilt || verdict.triggers_expected == self.header.expected_triggers)
            && verdict.status == verdict.judge()
    }

    /// One more than the highest trigger in the records.
    fn known_end(&self) -> u64 {
        let last = self.outcomes.iter().filter_map(|outcomes| outcomes.last_key_value()).map(|(t, _)| *t);
        let damaged = self.damaged.iter().filter_map(|damaged| damaged.last().copied());
        let table = self.triggers.last_key_value().map(|(index, _)| *index);
        last.chain(damaged).chain(table).max().map_or(0, |trigger| trigger + 1)
    }

    /// Triggers of the session, as far as this recording knows.
    pub fn end(&self) -> u64 {
        let stated = self.verdict.as_ref().map_or(0, |verdict| verdict.triggers.min(MAX_TRIGGERS));
        self.known_end().max(stated)
    }

    /// What the HSU counted, if the recording was finished and knows.
    pub fn emitted(&self) -> Option<u64> {
        self.verdict.as_ref().and_then(|verdict| verdict.triggers_emitted)
    }

    /// Whether it has no verdict of its own.
    pub fn interrupted(&self) -> bool {
        self.verdict.is_none()
    }

    /// Why an outcome is absent.
    pub fn cause(&self, camera: usize, trigger: TriggerIndex) -> GapCause {
        let trigger = trigger.0;
        let later = self.outcomes[camera].last_key_value().is_some_and(|(last, _)| *last > trigger);
        let written = self.verdict.as_ref().is_some_and(|verdict| trigger < verdict.triggers);
        if trigger < self.first_trigger || (self.fragment && self.damage.is_empty()) {
            // It is in another segment, which was not given.
            GapCause::NotRecorded
        } else if self.damaged[camera].contains(&trigger) || written || (later && !self.damage.is_empty()) {
            GapCause::Damaged
        } else {
            GapCause::Aborted
        }
    }

    /// Bytes of all segments.
    pub fn bytes(&self) -> u64 {
        self.files.iter().flatten().map(|file| file.len() as u64).sum()
    }

    /// Bytes of all whole frames.
    pub fn frame_bytes(&self) -> u64 {
        let length = |outcome: &Outcome| match outcome {
            Outcome::Frame { length, .. } => *length as u64,
            Outcome::Gap(_) => 0,
        };
        self.outcomes.iter().flat_map(|outcomes| outcomes.values()).map(length).sum()
    }

    /// A frame's message, into `message`.
    pub fn read(&self, segment: usize, offset: usize, length: usize, message: &mut Vec<u8>) -> bool {
        message.resize(length, 0);
        let file = self.files.get(segment).and_then(Option::as_ref);
        file.is_some_and(|file| file.read(offset, message).is_ok())
    }
}
