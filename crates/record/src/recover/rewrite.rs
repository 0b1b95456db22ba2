// SPDX-License-Identifier: MIT OR Apache-2.0
//! Writes what was salvaged as a new recording, through the same writer that records sessions.

use super::merge::Salvage;
use super::{
    AddedGaps, DAMAGED, RECORDS_LOST, RECOVERED, RecoveredRecording, SessionExtent, WriteResult, by_cause,
};
use crate::base::ids::TriggerIndex;
use crate::base::time::host_time_ns;
use crate::frame_check::check_frame;
use crate::layout::{ClockSample, GapCause, NodeEvent};
use crate::reader::Outcome;
use crate::verdict::{SessionEnd, Verdict};
use crate::writer::{Recording, WriterOptions};
use std::iter::Peekable;
use std::path::Path;
use std::slice::Iter;

/// Free space that is left on the disk, bytes: small, because recovery is often run on a disk that is almost full.
const RESERVE_BYTES: u64 = 64 << 20;

/// Writes the recording to `dir`, which must not exist. `advance` is called with the bytes of the source that are done.
pub fn write(
    source: &Salvage,
    dir: &Path,
    extent: SessionExtent,
    advance: &dyn Fn(u64),
) -> WriteResult<RecoveredRecording> {
    let options =
        WriterOptions { reserve_bytes: RESERVE_BYTES, preallocate: false, ..WriterOptions::default() };
    let mut recording = Recording::create_for(
        dir,
        source.header.clone(),
        options,
        source.frame_bytes(),
        source.belonging.version,
        Recording::disk(),
    )?;
    recording.state_statistics(source.statistics);
    let mut copy = Copy {
        source,
        recording,
        samples: source.clock_samples.iter().peekable(),
        events: source.events.iter().peekable(),
        added: Vec::new(),
        advance,
        advanced: 0,
        message: Vec::new(),
    };
    let triggers = extent.triggers.filter(|_| !source.fragment).unwrap_or(0).max(source.end());
    for trigger in 0..triggers {
        copy.trigger(TriggerIndex(trigger))?;
    }
    copy.finish(triggers, extent)
}

struct Copy<'a> {
    source: &'a Salvage,
    recording: Recording,
    samples: Peekable<Iter<'a, ClockSample>>,
    events: Peekable<Iter<'a, NodeEvent>>,
    added: Vec<AddedGaps>,
    advance: &'a dyn Fn(u64),
    advanced: u64,
    /// Message of the frame that is copied, kept to reuse its memory.
    message: Vec<u8>,
}

impl Copy<'_> {
    /// Everything of one trigger, and what happened before it.
    fn trigger(&mut self, trigger: TriggerIndex) -> WriteResult<()> {
        if let Some(row) = self.source.triggers.get(&trigger.0) {
            self.small_records(row.host_time_ns)?;
            self.recording.trigger(row)?;
        }
        for camera in 0..self.source.outcomes.len() {
            match self.source.outcomes[camera].get(&trigger.0) {
                Some(Outcome::Gap(cause)) => self.recording.gap(camera, trigger, *cause)?,
                Some(&Outcome::Frame { segment, offset, length }) => {
                    self.frame(camera, trigger, (segment, offset, length))?;
                }
                None => self.add_gap(camera, trigger, self.source.cause(camera, trigger))?,
            }
        }
        Ok(())
    }

    /// A frame as it is in the source, if it still is what was found.
    fn frame(
        &mut self,
        camera: usize,
        trigger: TriggerIndex,
        place: (usize, usize, usize),
    ) -> WriteResult<()> {
        let (segment, offset, length) = place;
        let there = self.source.read(segment, offset, length, &mut self.message);
        match check_frame(&self.message, camera, trigger, &self.source.header, &self.source.belonging) {
            Ok((meta, _)) if there => self.recording.frame(camera, &meta, &self.message)?,
            _ => self.add_gap(camera, trigger, GapCause::Damaged)?,
        }
        self.advanced += length as u64;
        (self.advance)(length as u64);
        Ok(())
    }

    fn add_gap(&mut self, camera: usize, trigger: TriggerIndex, cause: GapCause) -> WriteResult<()> {
        let id = &self.source.header.cameras[camera].id;
        // Runs of several cameras grow side by side.
        let cameras = self.source.header.cameras.len();
        let mut latest = self.added.iter_mut().rev().take(cameras);
        let run = latest.find(|run| run.camera == *id && run.cause == cause && run.last.0 + 1 == trigger.0);
        match run {
            Some(run) => run.last = trigger,
            None => self.added.push(AddedGaps { camera: id.clone(), first: trigger, last: trigger, cause }),
        }
        self.recording.gap(camera, trigger, cause)
    }

    /// Samples and events up to this time, each in the order of the source.
    fn small_records(&mut self, until_ns: u64) -> WriteResult<()> {
        while let Some(sample) = self.samples.next_if(|sample| sample.host_receive_ns <= until_ns) {
            self.recording.clock_sample(sample)?;
        }
        while let Some(event) = self.events.next_if(|event| event.host_time_ns <= until_ns) {
            self.recording.event(event)?;
        }
        Ok(())
    }

    fn finish(mut self, triggers: u64, extent: SessionExtent) -> WriteResult<RecoveredRecording> {
        self.small_records(u64::MAX)?;
        (self.advance)(self.source.bytes().saturating_sub(self.advanced));
        let source = self.source;
        self.recording.event(&NodeEvent::new(RECOVERED, host_time_ns(), self.description(triggers)))?;
        let stored = source.verdict.as_ref();
        let emitted = if extent.triggers.is_some() { extent.emitted } else { source.emitted() };
        let verdict: Verdict = self.recording.finish(SessionEnd {
            triggers_emitted: emitted.filter(|emitted| *emitted >= triggers),
            aborted: stored
                .map_or_else(|| Some(why_aborted(source, triggers)), |verdict| verdict.aborted.clone()),
            absent: GapCause::Aborted,
            host_time_ns: 0,
        })?;
        Ok(RecoveredRecording {
            node: source.header.node.clone(),
            source: source.path.clone(),
            out: Path::new("").to_owned(),
            interrupted: source.interrupted(),
            verdict,
            added: self.added,
            damage: source.damage.clone(),
            records_lost: source.records_lost,
        })
    }

    fn description(&self, triggers: u64) -> String {
        let from = self.source.path.display();
        let frames: usize =
            self.source.outcomes.iter().flat_map(|o| o.values()).filter(|o| is_frame(o)).count();
        let mut text = format!(
            "recovered from {from} by fourdbody {}: {triggers} triggers, {frames} frames",
            env!("CARGO_PKG_VERSION")
        );
        for (cause, count) in by_cause(&self.added) {
            text.push_str(&format!(", {count} gap records added: {cause}"));
        }
        match self.source.damage.len() {
            0 => {}
            count => text.push_str(&format!("; {count} {DAMAGED}")),
        }
        match self.source.records_lost {
            0 => {}
            count => text.push_str(&format!("; {count} {RECORDS_LOST}")),
        }
        text
    }
}

fn is_frame(outcome: &Outcome) -> bool {
    matches!(outcome, Outcome::Frame { .. })
}

fn why_aborted(source: &Salvage, triggers: u64) -> String {
    let from = source.path.display();
    if source.fragment {
        return format!("a single segment of a longer recording, recovered from {from}");
    }
    match triggers.checked_sub(1) {
        Some(last) => format!(
            "interrupted: no verdict was written, the last trigger known is {last}; recovered from {from}"
        ),
        None => format!("interrupted before the first trigger; recovered from {from}"),
    }
}
