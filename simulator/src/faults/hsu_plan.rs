// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which fault happens to the HSU and its serial lines at which trigger: the table `[hsu]` of a plan.

use super::plan::PlanError;
use crate::hsu::{Jitter, LineFaults};
use crate::random::{hash, share};
use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;

/// A kind of fault of the unit or of one of its lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum HsuKind {
    /// One line carries nothing in either direction for a while.
    LinkSilent,
    /// One node's cable is out for a while: its serial device is gone.
    LinkUnplugged,
    /// The unit restarts and has forgotten the session.
    HsuRestart,
}

impl HsuKind {
    /// All kinds of faults of the HSU and its link.
    pub const ALL: [Self; 3] = [Self::LinkSilent, Self::LinkUnplugged, Self::HsuRestart];

    /// The kind of this name.
    pub fn parse(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.to_string() == name)
    }
}

impl fmt::Display for HsuKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::LinkSilent => "link_silent",
            Self::LinkUnplugged => "link_unplugged",
            Self::HsuRestart => "hsu_restart",
        })
    }
}

/// One fault at one trigger.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HsuFault {
    pub kind: HsuKind,
    /// To the line of which node; `None`: chance decides, or it is the unit itself.
    pub node: Option<String>,
    pub lasts: Duration,
}

/// What to inject into the HSU and its lines; nothing by default.
#[derive(Debug, Clone, PartialEq)]
pub struct HsuPlan {
    /// What the lines do all the time; its seed is the plan's.
    pub line: LineFaults,
    /// Probability per trigger, by kind.
    pub probability: BTreeMap<HsuKind, f64>,
    pub named: Vec<(i64, HsuFault)>,
    /// No fault by chance before this trigger.
    pub first_trigger: i64,
    /// So many triggers without a fault by chance after each.
    pub clear_triggers: i64,
    /// How long silences and absences by chance last: at least, at most.
    pub lasts: (Duration, Duration),
}

impl Default for HsuPlan {
    fn default() -> Self {
        Self {
            line: LineFaults::default(),
            probability: BTreeMap::new(),
            named: Vec::new(),
            first_trigger: 50,
            clear_triggers: 500,
            lasts: (Duration::from_millis(50), Duration::from_millis(4_000)),
        }
    }
}

impl HsuPlan {
    /// Whether there is anything to inject.
    pub fn is_empty(&self) -> bool {
        *self
            == Self { line: LineFaults { seed: self.line.seed, ..LineFaults::default() }, ..Self::default() }
    }

    /// The fault at this trigger, whatever happened before; triggers below 0 are warm-up and have none.
    pub fn draw(&self, seed: u64, trigger: i64) -> Option<HsuFault> {
        if let Some((_, fault)) = self.named.iter().find(|(at, _)| *at == trigger) {
            return Some(fault.clone());
        }
        if trigger < self.first_trigger.max(0) {
            return None;
        }
        let words = |purpose| [u64::MAX, trigger as u64, purpose];
        let mut uniform = share(hash(seed, &words(1)));
        for (kind, probability) in &self.probability {
            if uniform < *probability {
                let span = (self.lasts.1 - self.lasts.0).as_millis() as u64;
                let extra = Duration::from_millis(hash(seed, &words(2)) % (span + 1));
                return Some(HsuFault { kind: *kind, node: None, lasts: self.lasts.0 + extra });
            }
            uniform -= probability;
        }
        None
    }

    /// Whether this trigger's fault is named in the plan.
    pub fn is_named(&self, trigger: i64) -> bool {
        self.named.iter().any(|(at, _)| *at == trigger)
    }

    /// Which of `count` lines chance picks at a trigger.
    pub fn pick_line(seed: u64, trigger: i64, count: usize) -> usize {
        (hash(seed, &[u64::MAX, trigger as u64, 3]) % count.max(1) as u64) as usize
    }

    pub(super) fn of_table(table: &HsuTable, seed: u64) -> Result<Self, PlanError> {
        let wrong = |message: String| PlanError(format!("[hsu]: {message}"));
        let defaults = Self::default();
        let milliseconds = |key: &str, value: Option<f64>| match value.unwrap_or(0.0) {
            ms if (0.0..=60_000.0).contains(&ms) => Ok(Duration::from_secs_f64(ms / 1e3)),
            ms => Err(wrong(format!("{key} is {ms}, expected 0 to 60000"))),
        };
        let rates = [table.flips_per_million, table.drops_per_million, table.inserts_per_million]
            .map(Option::unwrap_or_default);
        if rates.iter().map(|rate| u64::from(*rate)).sum::<u64>() > 1_000_000 {
            return Err(wrong("more than every byte is disturbed".to_owned()));
        }
        let line = LineFaults {
            seed,
            delay: milliseconds("delay_ms", table.delay_ms)?,
            jitter: milliseconds("jitter_ms", table.jitter_ms)?,
            distribution: table.jitter.unwrap_or_default(),
            flips_per_million: rates[0],
            drops_per_million: rates[1],
            inserts_per_million: rates[2],
        };
        let kind_of = |name: &str| {
            let known = HsuKind::ALL.map(|kind| kind.to_string()).join(", ");
            HsuKind::parse(name).ok_or_else(|| wrong(format!("kind {name:?}: expected one of {known}")))
        };
        let mut probability = BTreeMap::new();
        for (name, value) in &table.probability {
            probability.insert(kind_of(name)?, *value);
        }
        let sum: f64 = probability.values().sum();
        if probability.values().any(|p| !(0.0..=1.0).contains(p)) || sum > 1.0 {
            return Err(wrong(format!("probabilities must be 0 to 1 and their sum at most 1, found {sum}")));
        }
        let mut named = Vec::new();
        for fault in &table.fault {
            let (kind, lasts) = (kind_of(&fault.kind)?, milliseconds("ms", fault.ms)?);
            if fault.trigger < 0 || (lasts.is_zero() && kind != HsuKind::HsuRestart) {
                return Err(wrong(format!("fault {}: expected a trigger from 0 on, and its ms", fault.kind)));
            }
            named.push((fault.trigger, HsuFault { kind, node: fault.node.clone(), lasts }));
        }
        let lasts = match table.lasts_ms {
            None => defaults.lasts,
            Some([least, most]) if (1..=most).contains(&least) && most <= 60_000 => {
                (Duration::from_millis(least), Duration::from_millis(most))
            }
            Some(found) => {
                return Err(wrong(format!(
                    "lasts_ms is {found:?}, expected two rising numbers of 1 to 60000"
                )));
            }
        };
        let first_trigger = table.first_trigger.unwrap_or(defaults.first_trigger);
        let clear_triggers = table.clear_triggers.unwrap_or(defaults.clear_triggers);
        if [first_trigger, clear_triggers].iter().any(|limit| !(0..=1_000_000).contains(limit)) {
            return Err(wrong("expected first_trigger and clear_triggers within 0..=1000000".to_owned()));
        }
        Ok(Self { line, probability, named, first_trigger, clear_triggers, lasts })
    }
}

/// As it is written in a file.
#[derive(Debug, Default, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct HsuTable {
    delay_ms: Option<f64>,
    jitter_ms: Option<f64>,
    jitter: Option<Jitter>,
    flips_per_million: Option<u32>,
    drops_per_million: Option<u32>,
    inserts_per_million: Option<u32>,
    first_trigger: Option<i64>,
    clear_triggers: Option<i64>,
    lasts_ms: Option<[u64; 2]>,
    #[serde(default)]
    probability: BTreeMap<String, f64>,
    #[serde(default)]
    fault: Vec<NamedTable>,
}

#[derive(Debug, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct NamedTable {
    kind: String,
    node: Option<String>,
    trigger: i64,
    ms: Option<f64>,
}

#[cfg(test)]
mod tests {
    use super::HsuKind;
    use crate::faults::FaultPlan;
    use crate::hsu::Jitter;
    use std::time::Duration;

    #[test]
    fn nothing_is_injected_that_is_not_asked_for() {
        let plan = FaultPlan::parse("[faults]\nseed = 3\n[faults.probability]\n").expect("valid");
        assert!(plan.hsu.is_empty());
        assert!((0..10_000).all(|trigger| plan.hsu.draw(plan.seed, trigger).is_none()));
    }

    #[test]
    fn a_table_says_what_happens() {
        let text = "[faults]\nseed = 3\n[hsu]\njitter_ms = 2.0\njitter = \"exponential\"\nflips_per_million = 5\n\
            lasts_ms = [10, 20]\n[hsu.probability]\nlink_silent = 0.01\n\
            [[hsu.fault]]\nkind = \"link_unplugged\"\nnode = \"b\"\ntrigger = 7\nms = 300\n";
        let plan = FaultPlan::parse(text).expect("valid");
        assert_eq!((plan.hsu.line.jitter, plan.hsu.line.seed), (Duration::from_millis(2), 3));
        assert_eq!(plan.hsu.line.distribution, Jitter::Exponential);
        assert!(!plan.hsu.is_empty() && plan.hsu.is_named(7));
        let named = plan.hsu.draw(plan.seed, 7).expect("named");
        assert_eq!((named.kind, named.node.as_deref()), (HsuKind::LinkUnplugged, Some("b")));
        let faults: Vec<_> = (8..20_000).filter_map(|trigger| plan.hsu.draw(plan.seed, trigger)).collect();
        assert!((150..250).contains(&faults.len()), "1 % of 20,000: {}", faults.len());
        let within = |d: Duration| (10..=20).contains(&d.as_millis());
        assert!(faults.iter().all(|f| f.kind == HsuKind::LinkSilent && within(f.lasts)));
    }

    #[test]
    fn the_shipped_scenario_is_a_plan() {
        let shipped = FaultPlan::parse(include_str!("../../../config/scenarios/absences.toml"));
        let plan = shipped.expect("a valid plan");
        assert!(plan.needs_stranger() && plan.hsu.line.delays() && plan.named.len() == 1);
    }

    #[test]
    fn wrong_tables_are_refused() {
        for wrong in [
            "jitter_ms = -1.0",
            "jitter = \"normal\"",
            "lasts_ms = [20, 10]",
            "flips_per_million = 2000000",
            "no_such = 1",
            "probability = { link_silent = 1.5 }",
            "probability = { frame_lost = 0.1 }",
            "fault = [{ kind = \"link_silent\", trigger = 3 }]",
            "fault = [{ kind = \"hsu_restart\", trigger = -3 }]",
        ] {
            let text = format!("[faults]\nseed = 3\n[hsu]\n{wrong}\n");
            assert!(FaultPlan::parse(&text).is_err(), "{wrong}");
        }
    }
}
