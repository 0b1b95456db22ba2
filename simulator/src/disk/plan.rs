// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a simulated disk does wrong: the table `[disk]` of a fault plan.

use crate::random::{hash, text_number};
use serde::Deserialize;
use std::time::Duration;

/// Why a plan cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("[disk] {0}")]
pub struct DiskPlanError(pub String);

/// A number that is given, or drawn from a range by seed and node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(untagged)]
pub enum Amount {
    Exactly(u64),
    /// One of these, both ends included.
    Within(u64, u64),
}

impl Amount {
    fn draw(self, seed: u64, node: &str, purpose: &str) -> u64 {
        match self {
            Amount::Exactly(value) => value,
            Amount::Within(from, to) => {
                let bits = hash(seed, &[text_number(node), text_number(purpose)]);
                from + bits % (to - from).saturating_add(1)
            }
        }
    }

    fn check(self, what: &str) -> Result<(), DiskPlanError> {
        match self {
            Amount::Within(from, to) if from > to => {
                Err(DiskPlanError(format!("{what} is [{from}, {to}], expected the smaller number first")))
            }
            _ => Ok(()),
        }
    }
}

/// A disk that takes its time.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Slow {
    /// Median of what a write takes, ms; its logarithm is normally distributed.
    #[serde(default)]
    pub latency_ms: f64,
    /// Standard deviation of the latency's natural logarithm; at most 3.
    #[serde(default)]
    pub spread: f64,
    /// What it writes in a second at most.
    pub bytes_per_s: Option<u64>,
    /// Bytes that it takes at full speed before.
    pub from_byte: Option<Amount>,
}

/// A disk of limited size.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Full {
    /// What it holds, bytes; files take whole blocks of 4096, but for the last one that still fits.
    pub capacity_bytes: Amount,
    /// The capacity that it reports (`statvfs`); more than the capacity where a quota or thin provisioning is the
    /// real bound. By default the truth.
    pub announced_bytes: Option<u64>,
}

/// The operations of a disk that can fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Operation {
    Write,
    /// `fsync` and `fdatasync` of files; what was written since the last good one is gone.
    Sync,
}

/// An I/O error of a disk, by the plan.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IoFault {
    pub on: Operation,
    /// The n-th such call to the disk, from 1 on.
    pub nth: Option<Amount>,
    /// The call with this byte of all that was written to the disk; the bytes before are taken. Writes only.
    pub at_byte: Option<Amount>,
    /// Each such call with this probability.
    pub probability: Option<f64>,
    /// From then on the disk is gone: every call that would change something fails.
    #[serde(default)]
    pub for_good: bool,
}

/// Bytes of a file that cannot be read: an I/O error for each call that concerns one of them.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReadFault {
    /// The file, below the disk's root.
    pub path: String,
    pub from: u64,
    /// Behind the last byte; to the file's end by default.
    pub to: Option<u64>,
}

/// The faults of the disks of a laboratory; by default there are none.
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DiskPlan {
    /// Decides everything that is left to chance.
    pub seed: u64,
    /// Nodes with such a disk; by default all, each with its own.
    #[serde(default)]
    pub nodes: Vec<String>,
    /// Whether space can be set aside (`fallocate`), as most file systems allow.
    #[serde(default = "yes")]
    pub fallocate: bool,
    pub slow: Option<Slow>,
    pub full: Option<Full>,
    #[serde(default)]
    pub error: Vec<IoFault>,
    #[serde(default)]
    pub unreadable: Vec<ReadFault>,
}

fn yes() -> bool {
    true
}

#[derive(Deserialize)]
struct PlanFile {
    disk: Option<DiskPlan>,
}

impl DiskPlan {
    /// Reads the table `[disk]` of a TOML text, if there is one.
    ///
    /// # Errors
    /// Text that is no TOML, an unknown key, a number out of range.
    pub fn parse(text: &str) -> Result<Option<Self>, DiskPlanError> {
        let file: PlanFile = toml::from_str(text).map_err(|e| DiskPlanError(e.to_string()))?;
        if let Some(plan) = &file.disk {
            plan.check()?;
        }
        Ok(file.disk)
    }

    /// Whether this node's disk is a simulated one.
    pub fn concerns(&self, node: &str) -> bool {
        self.nodes.is_empty() || self.nodes.iter().any(|name| name == node)
    }

    /// What must hold for a plan to mean something.
    pub(super) fn check(&self) -> Result<(), DiskPlanError> {
        let wrong = |message: String| Err(DiskPlanError(message));
        if let Some(slow) = &self.slow {
            if !(0.0..=10_000.0).contains(&slow.latency_ms) || !(0.0..=3.0).contains(&slow.spread) {
                let (latency, spread) = (slow.latency_ms, slow.spread);
                return wrong(format!(
                    "slow.latency_ms is {latency} and slow.spread {spread}, expected 0 to 10000 and 0 to 3"
                ));
            }
            if slow.bytes_per_s == Some(0) {
                return wrong("slow.bytes_per_s is 0, expected at least 1".to_owned());
            }
            slow.from_byte.map_or(Ok(()), |amount| amount.check("slow.from_byte"))?;
        }
        self.full.as_ref().map_or(Ok(()), |full| full.capacity_bytes.check("full.capacity_bytes"))?;
        if let Some(fault) = self.unreadable.iter().find(|fault| fault.to.is_some_and(|to| to <= fault.from))
        {
            let ReadFault { path, from, .. } = fault;
            return wrong(format!("unreadable: {path} from byte {from} to one that is not behind it"));
        }
        for fault in &self.error {
            let given = [fault.nth.is_some(), fault.at_byte.is_some(), fault.probability.is_some()];
            if given.iter().filter(|given| **given).count() != 1 {
                return wrong("error: expected one of nth, at_byte and probability".to_owned());
            }
            if fault.on == Operation::Sync && fault.at_byte.is_some() {
                return wrong("error.at_byte: expected on = \"write\"".to_owned());
            }
            if fault.probability.is_some_and(|p| !(0.0..=1.0).contains(&p)) {
                return wrong("error.probability: expected 0 to 1".to_owned());
            }
            fault.nth.map_or(Ok(()), |amount| amount.check("error.nth"))?;
            fault.at_byte.map_or(Ok(()), |amount| amount.check("error.at_byte"))?;
        }
        Ok(())
    }

    /// The plan of one node, with everything drawn that does not depend on what happens.
    pub(super) fn drawn(&self, node: &str) -> Drawn {
        let draw = |amount: Amount, purpose: &str| amount.draw(self.seed, node, purpose);
        let fault = |(number, fault): (usize, &IoFault)| DrawnFault {
            on: fault.on,
            nth: fault.nth.map(|amount| draw(amount, &format!("nth {number}"))),
            at_byte: fault.at_byte.map(|amount| draw(amount, &format!("at_byte {number}"))),
            probability: fault.probability.unwrap_or(0.0),
            for_good: fault.for_good,
            over: false,
        };
        Drawn {
            chance: hash(self.seed, &[text_number(node)]),
            slow: self.slow.clone(),
            slow_from: self.slow.as_ref().and_then(|slow| slow.from_byte).map_or(0, |a| draw(a, "slow")),
            capacity: self.full.as_ref().map(|full| draw(full.capacity_bytes, "capacity")),
            announced: self.full.as_ref().and_then(|full| full.announced_bytes),
            faults: self.error.iter().enumerate().map(fault).collect(),
        }
    }
}

/// The part of a [`DiskPlan`] that concerns one disk.
#[derive(Debug, Clone)]
pub(super) struct Drawn {
    pub chance: u64,
    pub slow: Option<Slow>,
    pub slow_from: u64,
    pub capacity: Option<u64>,
    pub announced: Option<u64>,
    pub faults: Vec<DrawnFault>,
}

/// An [`IoFault`] with the chance of one disk.
#[derive(Debug, Clone)]
pub(super) struct DrawnFault {
    pub on: Operation,
    pub nth: Option<u64>,
    pub at_byte: Option<u64>,
    pub probability: f64,
    pub for_good: bool,
    /// It happened, and does not happen again.
    pub over: bool,
}

impl Slow {
    /// What the write of this number takes before the bandwidth is looked at.
    pub(super) fn latency(&self, chance: u64, write: u64) -> Duration {
        let mut stream = crate::random::Stream::new(hash(chance, &[write]), "latency");
        Duration::from_secs_f64(self.latency_ms / 1e3 * (self.spread * stream.normal()).exp())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plan_is_read_and_drawn_by_seed_and_node() {
        let text = "[disk]\nseed = 5\nnodes = [\"b\"]\n[disk.slow]\nlatency_ms = 2.0\nspread = 1.0\n\
                    [disk.full]\ncapacity_bytes = [1000, 1_000_000_000]\n\
                    [[disk.error]]\non = \"sync\"\nnth = [1, 1_000_000_000]\nfor_good = true\n";
        let plan = DiskPlan::parse(text).expect("valid").expect("there");
        assert!(plan.concerns("b") && !plan.concerns("a") && plan.fallocate);
        let (drawn, again) = (plan.drawn("b"), plan.drawn("b"));
        assert_eq!((drawn.capacity, drawn.faults[0].nth), (again.capacity, again.faults[0].nth));
        assert!((1000..=1_000_000_000).contains(&drawn.capacity.expect("limited")));
        assert_ne!(drawn.capacity, plan.drawn("a").capacity);
        assert_ne!(drawn.capacity, DiskPlan { seed: 6, ..plan.clone() }.drawn("b").capacity);
        assert_ne!(drawn.capacity, drawn.faults[0].nth, "every number is drawn for itself");
        assert_eq!(DiskPlan::parse("[faults]\nseed = 1\n"), Ok(None));
        let shipped = include_str!("../../../config/scenarios/disk.toml");
        assert!(DiskPlan::parse(shipped).expect("shipped").is_some());
    }

    #[test]
    fn latencies_have_the_median_that_was_asked_for() {
        let slow = Slow { latency_ms: 4.0, spread: 0.8, bytes_per_s: None, from_byte: None };
        let mut all: Vec<Duration> = (0..2001).map(|write| slow.latency(9, write)).collect();
        assert_eq!(all[7], slow.latency(9, 7));
        all.sort_unstable();
        let median = all[1000].as_secs_f64() * 1e3;
        assert!((3.6..4.4).contains(&median), "{median}");
        let ratio = all[1683].as_secs_f64() / all[1000].as_secs_f64();
        assert!((ratio.ln() - 0.8).abs() < 0.1, "one standard deviation above: {ratio}");
    }

    #[test]
    fn wrong_plans_are_refused() {
        for wrong in [
            "no_such = 1",
            "[disk.slow]\nlatency_ms = -1.0",
            "[disk.slow]\nspread = nan",
            "[disk.slow]\nbytes_per_s = 0",
            "[disk.full]\ncapacity_bytes = [5, 4]",
            "[disk.full]\ncapacity_bytes = \"much\"",
            "[[disk.error]]\non = \"write\"",
            "[[disk.error]]\non = \"read\"\nnth = 1",
            "[[disk.error]]\non = \"write\"\nnth = 1\nprobability = 0.5",
            "[[disk.error]]\non = \"sync\"\nat_byte = 1",
            "[[disk.unreadable]]\npath = \"s\"\nfrom = 5\nto = 5",
            "[[disk.error]]\non = \"write\"\nprobability = 1.5",
        ] {
            assert!(DiskPlan::parse(&format!("[disk]\nseed = 1\n{wrong}\n")).is_err(), "{wrong}");
        }
        assert!(DiskPlan::parse("[disk]\n").is_err(), "a seed is asked for");
    }
}
