// SPDX-License-Identifier: MIT OR Apache-2.0
//! When the unit and its lines fail, by the plan; and the lines of the truth file about it.

use crate::faults::{HsuFaults, HsuKind, HsuPlan, Injected};
use std::time::{Duration, Instant};

/// What the engine must do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Deed {
    /// The unit loses its power for a moment.
    Restart,
    /// A line falls silent, or is silent no more.
    Silence(usize, bool),
    /// A cable comes out, or goes in again.
    Unplug(usize, bool),
}

/// A silence from this length on must be noticed: a sign of life every 400 ms is tried four times for 250 ms.
const NOTICED: Duration = Duration::from_secs(3);

/// The faults of one unit while trains come and go.
#[derive(Debug)]
pub(super) struct Injector {
    faults: HsuFaults,
    train: u64,
    last: Option<i64>,
    /// No fault by chance before this trigger.
    clear_until: i64,
    ends: Vec<(Instant, Deed)>,
}

impl Injector {
    /// An injector before the first train begins.
    pub(super) fn new(faults: HsuFaults) -> Self {
        Self { faults, train: 0, last: None, clear_until: 0, ends: Vec::new() }
    }

    /// What happens at the trigger that was just fired. A number that is not above the last one's begins a train.
    pub(super) fn on_trigger(&mut self, number: i64, now: Instant) -> Option<Deed> {
        if self.last.is_none_or(|last| number <= last) {
            self.train += 1;
            self.clear_until = 0;
            if self.faults.plan.hsu.line.delays() {
                (0..self.faults.nodes.len()).for_each(|link| self.record(0, Some(link), "line_delay", &[]));
            }
        }
        self.last = Some(number);
        let plan = &self.faults.plan;
        let fault = plan.hsu.draw(plan.seed, number)?;
        if !plan.hsu.is_named(number) && (number < self.clear_until || !self.ends.is_empty()) {
            return None;
        }
        let lasts = fault.lasts;
        let link = match &fault.node {
            Some(node) => self.faults.nodes.iter().position(|known| known == node)?,
            None => HsuPlan::pick_line(plan.seed, number, self.faults.nodes.len()),
        };
        self.clear_until = number.saturating_add(plan.hsu.clear_triggers);
        let name = fault.kind.to_string();
        match fault.kind {
            HsuKind::HsuRestart => {
                self.record(number, None, &name, &["hsu_lost"]);
                Some(Deed::Restart)
            }
            HsuKind::LinkSilent => {
                let events: &[&str] = if lasts >= NOTICED { &["hsu_link_lost"] } else { &[] };
                self.record(number, Some(link), &name, events);
                self.ends.push((now + lasts, Deed::Silence(link, false)));
                Some(Deed::Silence(link, true))
            }
            HsuKind::LinkUnplugged => {
                self.record(number, Some(link), &name, &["hsu_link_lost", "hsu_link_back"]);
                self.ends.push((now + lasts, Deed::Unplug(link, false)));
                Some(Deed::Unplug(link, true))
            }
        }
    }

    /// What has ended by now.
    pub(super) fn ended(&mut self, now: Instant) -> Vec<Deed> {
        let over = |entry: &mut (Instant, Deed)| entry.0 <= now;
        self.ends.extract_if(.., over).map(|(_, deed)| deed).collect()
    }

    /// Bytes on a line were disturbed.
    pub(super) fn disturbed(&self, link: usize) {
        // Before the first trigger there is no recording that could show it.
        if let Some(trigger) = self.last {
            self.record(trigger, Some(link), "line_noise", &[]);
        }
    }

    fn record(&self, number: i64, link: Option<usize>, kind: &str, events: &[&str]) {
        let node = link.and_then(|link| self.faults.nodes.get(link)).cloned();
        let trigger = u64::try_from(number).unwrap_or(0);
        self.faults.truth.write_down(&Injected {
            node,
            events: events.iter().map(|event| (*event).to_owned()).collect(),
            ..Injected::at(self.train, trigger, kind)
        });
    }
}
