// SPDX-License-Identifier: MIT OR Apache-2.0
//! One recording's segments together: the header that is used, one outcome for each camera and trigger, and how
//! the session ended.

use super::header;
use super::salvage::{Damage, Labelled, SegmentScan, SmallRecord, scan};
use crate::base::ids::TriggerIndex;
use crate::belonging::{Belonging, SessionMark};
use crate::credible::most_triggers;
use crate::files::RecordingFiles;
use crate::layout::{
    ClockSample, GapCause, MAX_TRIGGERS, NodeEvent, RecordingHeader, TriggerRecord, VERSION, segment_name,
};
use crate::metadata::foreign_reason;
use crate::reader::Outcome;
use crate::scan::open_segment;
use crate::segment_file::SegmentFile;
use crate::statistics::WriteStatistics;
use crate::verdict::{TriggerSet, Verdict};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

/// What is left of one node's recording. Recovery makes one for each recording, and writes the copy from it.
pub struct Salvage {
    /// Its directory, or the single segment.
    pub path: PathBuf,
    /// The header that is used, possibly rebuilt.
    pub header: RecordingHeader,
    /// Whether the header was not readable and was rebuilt.
    pub rebuilt: bool,
    /// Whether a checksum proves the header.
    pub proven: bool,
    /// The mark that its records must have.
    pub belonging: Belonging,
    /// Numbers of the small records that are there.
    numbers: TriggerSet,
    /// How many there were in all, if that is known.
    records: u64,
    /// The segments, in order; `None` where one cannot be opened.
    pub files: Vec<Option<SegmentFile>>,
    /// Per camera of the header.
    pub outcomes: Vec<BTreeMap<u64, Outcome>>,
    /// Per camera of the header: frames whose identity is known and whose pixels are damaged.
    pub damaged: Vec<BTreeSet<u64>>,
    pub triggers: BTreeMap<u64, TriggerRecord>,
    /// In the order of the files.
    pub clock_samples: Vec<ClockSample>,
    /// In the order of the files.
    pub events: Vec<NodeEvent>,
    /// The stored verdict, if a checksum proves it or it agrees with the records.
    pub verdict: Option<Verdict>,
    /// How the disk kept up with the original.
    pub statistics: Option<WriteStatistics>,
    /// First trigger of a single segment, 0 for a recording.
    pub first_trigger: u64,
    /// Whether this is one segment of a recording that had more.
    pub fragment: bool,
    pub damage: Vec<Damage>,
    /// Small records that were there, but under no checksum that is right.
    pub records_lost: u64,
}

/// Opens and scans all segments. One that cannot be opened costs what is in it; an error where nothing can be used.
pub fn salvage(files: &RecordingFiles, advance: &(dyn Fn(u64) + Sync)) -> Result<Salvage, String> {
    if let Some(reason) = &files.unlisted {
        return Err(reason.clone());
    }
    let (mut opened, mut closed_to_us) = (Vec::new(), Vec::new());
    for (number, path) in &files.segments {
        match open_segment(path) {
            Ok(file) => opened.push(Some(file)),
            Err(reason) => {
                closed_to_us.push((*number, format!("{}: {reason}", segment_name(*number))));
                opened.push(None);
            }
        }
    }
    if let Some((_, reason)) = closed_to_us.first().filter(|_| closed_to_us.len() == opened.len()) {
        return Err(reason.clone());
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
        .ok_or("no segment has a readable header or a whole frame")?;
    let (header, belonging) = belonging(header, proven, &scans);
    let single = files.path.is_file();
    let mut salvage = Salvage {
        path: files.path.clone(),
        outcomes: vec![BTreeMap::new(); header.cameras.len()],
        damaged: vec![BTreeSet::new(); header.cameras.len()],
        header,
        rebuilt,
        proven,
        belonging,
        numbers: TriggerSet::default(),
        records: 0,
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
        salvage.note(0, "no segment has a readable header: rebuilt from the frames");
    }
    salvage.note_missing_segments(files, single);
    closed_to_us.into_iter().for_each(|(number, reason)| salvage.note(number, reason));
    let numbers: Vec<u32> = files.segments.iter().map(|(number, _)| *number).collect();
    let closed: Vec<bool> = scans.iter().map(|scan| scan.closed).collect();
    for (place, scan) in scans.into_iter().enumerate() {
        let foreign = scan.header.as_ref().filter(|stated| stated.is_foreign(&salvage.header));
        match foreign.map(|stated| foreign_reason(&stated.header)) {
            Some(reason) => salvage.note(numbers[place], reason),
            None => salvage.take(place, numbers[place], scan),
        }
    }
    salvage.note_cut_segments(&numbers, &closed);
    salvage.note_missing_records();
    salvage.leave_out_the_incredible();
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
    /// refused it: then an event names it.
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

    /// Small records have numbers: those that are absent were lost, even where nothing else shows it. A single segment
    /// has only some of them.
    fn note_missing_records(&mut self) {
        let end = self.records.max(self.numbers.end()).min(MAX_TRIGGERS);
        let absent: u64 = self.numbers.absent(end).iter().map(|range| range.end - range.start).sum();
        if absent > 0 && !self.path.is_file() {
            // Those that are there without a checksum are among them.
            self.records_lost = self.records_lost.max(absent);
        }
    }

    /// Leaves out what lies so far behind everything else that the gap records between would exceed [`most_triggers`].
    fn leave_out_the_incredible(&mut self) {
        let cameras = self.outcomes.len() as u64;
        let most = most_triggers(self.bytes());
        let mut there: BTreeMap<u64, u64> = BTreeMap::new();
        for trigger in self.outcomes.iter().flat_map(BTreeMap::keys) {
            *there.entry(*trigger).or_default() += 1;
        }
        let others = self.damaged.iter().flatten().chain(self.triggers.keys());
        for trigger in others {
            there.entry(*trigger).or_default();
        }
        let stated = self.verdict.as_ref().map_or(0, |verdict| verdict.triggers);
        if let Some(last) = stated.checked_sub(1) {
            there.entry(last).or_default();
        }
        let (mut known, mut end) = (0, 0);
        for (trigger, outcomes) in &there {
            known += outcomes;
            if (trigger + 1) * cameras - known > most {
                break;
            }
            end = trigger + 1;
        }
        let Some((&last, _)) = there.last_key_value().filter(|(last, _)| **last >= end) else { return };
        let reason = format!(
            "records of triggers {end} to {last} are left out: a recording of {} bytes cannot have that many triggers",
            self.bytes()
        );
        self.note(0, reason);
        self.outcomes.iter_mut().for_each(|outcomes| drop(outcomes.split_off(&end)));
        self.damaged.iter_mut().for_each(|damaged| drop(damaged.split_off(&end)));
        drop(self.triggers.split_off(&end));
        self.verdict = self.verdict.take().filter(|verdict| verdict.triggers <= end);
    }

    /// The records that are of this session; the others are counted.
    fn own<T>(&mut self, records: Vec<Labelled<T>>, foreign: &mut u64) -> Vec<T> {
        let mut own = Vec::with_capacity(records.len());
        for Labelled { label, record } in records {
            if !self.belonging.admits(label.session) {
                *foreign += 1;
                continue;
            }
            if let Some(number) = label.number {
                self.numbers.insert(number);
            }
            own.push(record);
        }
        own
    }

    fn take(&mut self, place: usize, number: u32, mut scan: SegmentScan) {
        let belonging = self.belonging;
        let before = scan.frames.len();
        scan.frames.retain(|frame| belonging.admits(frame.session));
        scan.damaged_frames.retain(|(_, _, session)| belonging.admits(*session));
        let (frames, mut records) = (before - scan.frames.len(), 0);
        let small = self.own(scan.records, &mut records);
        let verdict = self.own(scan.verdict.into_iter().collect(), &mut records).pop();
        let statistics = self.own(scan.statistics.into_iter().collect(), &mut records).pop();
        if frames > 0 || records > 0 {
            let reason = format!(
                "{frames} frames and {records} other records are of another session, which the disk still held: they \
                 are left out"
            );
            self.note(number, reason);
        }
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
        for (camera, trigger, _) in scan.damaged_frames {
            if let Some(camera) = camera_of[camera].filter(|_| trigger < MAX_TRIGGERS) {
                self.damaged[camera].insert(trigger);
            }
        }
        for record in small {
            match record {
                SmallRecord::Gap(gap) => {
                    let camera = self.header.cameras.iter().position(|camera| camera.id == gap.camera);
                    if let Some(camera) = camera.filter(|_| gap.trigger.0 < MAX_TRIGGERS) {
                        self.outcomes[camera].entry(gap.trigger.0).or_insert(Outcome::Gap(gap.cause));
                    }
                }
                SmallRecord::Trigger(row) if row.index.0 < MAX_TRIGGERS => {
                    self.triggers.entry(row.index.0).or_insert(row);
                }
                SmallRecord::Trigger(_) => {}
                SmallRecord::Clock(sample) => self.clock_samples.push(sample),
                SmallRecord::Event(event) => self.events.push(event),
            }
        }
        if let Some(verdict) =
            verdict.filter(|verdict| scan.proven || scan.verdict_proven || self.agrees(verdict))
        {
            self.records = scan.stated_records.unwrap_or(0);
            self.verdict = Some(verdict);
        }
        self.statistics = statistics.or(self.statistics);
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

    /// The HSU's count of triggers, if the recording was finished and has it.
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

    /// Length of all segments together, bytes.
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

/// The mark that the records must have. An id that no checksum proves is compared with the marks of the frames: where
/// most contradict it, the id is damaged, and the recording stays without one.
fn belonging(
    mut header: RecordingHeader,
    proven: bool,
    scans: &[SegmentScan],
) -> (RecordingHeader, Belonging) {
    let own = scans.iter().filter_map(|scan| scan.header.as_ref()).filter(|one| !one.is_foreign(&header));
    let mut marks: BTreeMap<Option<SessionMark>, u64> = BTreeMap::new();
    for frame in scans.iter().flat_map(|scan| &scan.frames) {
        *marks.entry(frame.session).or_default() += 1;
    }
    let most = marks.into_iter().max_by_key(|(_, count)| *count).and_then(|(mark, _)| mark);
    let version = own.map(|one| one.version).max().unwrap_or(if most.is_some() { VERSION } else { 1 });
    let mut belonging = Belonging::of(&header, version);
    if !proven && most.is_some() && belonging.own != most {
        header.session_id.clear();
        belonging.own = most;
    }
    (header, belonging)
}
