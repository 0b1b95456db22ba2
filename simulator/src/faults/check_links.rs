// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a recording must state about faults of the HSU and its lines: they cost no frame, and what was noticed is an
//! event; only a unit that restarts ends the session, and with it the last triggers.

use super::check::Accounting;
use super::truth::Injected;
use fourdbody::record::RecordingReader;

/// Triggers before a restart whose edges may not have reached the cameras, and their reports not the nodes.
const UNDER_WAY: u64 = 2;

/// The faults of the HSU, and of the line of one node, in one train.
pub(super) struct Links<'a> {
    faults: Vec<&'a Injected>,
    restart: Option<u64>,
}

impl<'a> Links<'a> {
    /// Those that concern this recording.
    pub(super) fn of(truth: &'a [Injected], train: u64, recording: &RecordingReader) -> Self {
        let node = recording.header.node.to_string();
        let ours = |fault: &&Injected| {
            fault.train == train
                && fault.camera.is_empty()
                && fault.node.as_ref().is_none_or(|name| *name == node)
        };
        let faults: Vec<&Injected> = truth.iter().filter(ours).collect();
        let restart = faults.iter().find(|fault| fault.kind == "hsu_restart").map(|fault| fault.trigger);
        Self { faults, restart }
    }

    /// Whether every trigger of the train was reported.
    pub(super) fn ends_whole(&self) -> bool {
        self.restart.is_none()
    }

    /// Whether a trigger may have been cut off by a restart: any outcome is right then.
    pub(super) fn is_cut_off(&self, trigger: u64) -> bool {
        self.restart.is_some_and(|restart| trigger + UNDER_WAY > restart)
    }

    /// Counts these faults, and looks for their events; as often as they happened.
    pub(super) fn judge(&self, recording: &RecordingReader, into: &mut Accounting) {
        for (number, fault) in self.faults.iter().enumerate() {
            let earlier = &self.faults[..number];
            let missing = fault.events.iter().find(|kind| {
                let needed = 1 + earlier.iter().filter(|other| other.events.contains(*kind)).count();
                recording.events.iter().filter(|event| event.kind == **kind).count() < needed
            });
            into.count(&fault.kind, missing.is_none());
            if let Some(kind) = missing {
                let place = recording.path.display();
                into.mismatch(format!(
                    "{place}: {} at trigger {}: no event {kind}",
                    fault.kind, fault.trigger
                ));
            }
        }
        let end = recording.triggers_end();
        if let Some(restart) = self.restart.filter(|restart| end > restart + 1 || end + UNDER_WAY <= *restart)
        {
            let place = recording.path.display();
            into.mismatch(format!("{place}: the HSU restarted at trigger {restart}, but it ends with {end}"));
        }
    }
}
