// SPDX-License-Identifier: MIT OR Apache-2.0
//! A session without a disk: every frame is matched, checked and counted, and its memory is freed at once.

use super::writer_queue::{Sink, ToWriter};
use crate::base::ids::TriggerIndex;
use crate::record::{CameraTally, Noted, RecordError, RecordingHeader, SessionEnd, TriggerSet, Verdict};

/// The destination of a dry run, in place of a recording.
#[derive(Debug)]
pub struct DryRun {
    header: RecordingHeader,
    tallies: Vec<CameraTally>,
    rows: TriggerSet,
    noted: Noted,
}

impl DryRun {
    /// A dry run of the session that `header` describes; nothing is created on disk.
    pub fn new(header: RecordingHeader) -> Self {
        let tallies = vec![CameraTally::default(); header.cameras.len()];
        Self { header, tallies, rows: TriggerSet::default(), noted: Noted::default() }
    }
}

impl Sink for DryRun {
    fn write(&mut self, item: ToWriter) -> Result<(), RecordError> {
        let fresh = match item {
            ToWriter::Frame(frame) => {
                self.tallies.get_mut(frame.camera).is_none_or(|tally| tally.frame(frame.meta.trigger))
            }
            ToWriter::Gap(camera, trigger, cause) => {
                self.tallies.get_mut(camera).is_none_or(|tally| tally.gap(trigger, cause))
            }
            ToWriter::Trigger(record) => {
                self.rows.insert(record.index.0);
                true
            }
            ToWriter::Event(event) => {
                self.noted.note(&event);
                true
            }
            ToWriter::Clock(_) | ToWriter::End(_) => true,
        };
        self.noted.refused += u64::from(!fresh);
        Ok(())
    }

    fn finish(mut self: Box<Self>, end: SessionEnd) -> Result<Verdict, RecordError> {
        let triggers = Verdict::triggers(&self.tallies, self.rows.end(), &end);
        for tally in &mut self.tallies {
            for trigger in tally.seen().absent(triggers).into_iter().flatten() {
                tally.gap(TriggerIndex(trigger), end.absent);
            }
        }
        Ok(Verdict::of(&self.header, &self.tallies, &self.rows, triggers, self.noted, end))
    }
}

#[cfg(test)]
mod tests {
    use super::DryRun;
    use crate::acquire::writer_queue::{Sink, ToWriter};
    use crate::base::ids::TriggerIndex;
    use crate::base::ids::{CameraId, NodeId, SessionName};
    use crate::record::{CameraHeader, GapCause, RecordingHeader, SessionEnd, Status, TriggerRecord};

    /// Of two cameras and four triggers.
    fn header() -> RecordingHeader {
        let camera = |id: &str| CameraHeader {
            id: CameraId::from(id),
            width: 8,
            height: 8,
            device: String::new(),
            pixel_format: String::new(),
            settings: Vec::new(),
            state: std::collections::BTreeMap::new(),
        };
        RecordingHeader {
            session: SessionName::from("s"),
            session_id: "1".to_owned(),
            node: NodeId::from("a"),
            rig_text: String::new(),
            cameras: ["up", "low"].map(camera).into(),
            hsu: None,
            expected_triggers: Some(4),
            trigger_rate_hz: 120.0,
            host_clock: "test".to_owned(),
            created_ns: 1,
            software: "test".to_owned(),
            subject: None,
            note: None,
        }
    }

    fn trigger(index: u64) -> ToWriter {
        ToWriter::Trigger(TriggerRecord {
            index: TriggerIndex(index),
            hsu_time_ns: index * 8_333_333,
            flags: 0,
            host_time_ns: 0,
        })
    }

    /// Accounting is that of a recording: every trigger of every camera ends with exactly one outcome.
    #[test]
    fn what_did_not_come_is_a_gap_and_a_second_outcome_is_refused() {
        let mut run = DryRun::new(header());
        for index in 0..4 {
            run.write(trigger(index)).expect("counted");
        }
        run.write(ToWriter::Gap(0, TriggerIndex(1), GapCause::MissingPackets)).expect("counted");
        run.write(ToWriter::Gap(0, TriggerIndex(1), GapCause::Timeout)).expect("counted");
        let end = SessionEnd {
            triggers_emitted: Some(4),
            aborted: None,
            absent: GapCause::Unknown,
            host_time_ns: 0,
        };
        let verdict = Box::new(run).finish(end).expect("nothing can fail");
        assert_eq!((verdict.triggers, verdict.frames(), verdict.gaps()), (4, 0, 8));
        assert_eq!((verdict.refused, verdict.status), (1, Status::Incomplete));
        assert_eq!(verdict.cameras[0].gaps[&GapCause::MissingPackets], 1);
    }
}
