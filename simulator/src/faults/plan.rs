// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which fault happens at which trigger of which camera: a function of seed, camera and trigger index.

use super::hsu_plan::{HsuPlan, HsuTable};
use crate::random::{hash, share, text_number};
use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;

/// What becomes of a request to send a lost packet again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub enum Resend {
    /// It is answered with the packet.
    #[default]
    Answered,
    /// It is answered with "not available".
    Refused,
    Ignored,
    /// It is answered when the receiver has given the frame up.
    Late,
}

/// What of a frame gets lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Part {
    Packet,
    /// Several payload packets in a row.
    Burst,
    /// The leader, which carries the timestamp.
    Leader,
    Trailer,
}

/// A kind of fault of a camera or its network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// No packet of the frame arrives.
    FrameLost,
    /// A part of it is lost on its first way.
    Lost(Part, Resend),
    /// All packets arrive, in another order.
    Reordered,
    Duplicated,
    /// A payload packet arrives cut short.
    Truncated,
    /// Datagrams that are no packets of the frame arrive among its packets.
    Malformed,
    /// The camera does not expose; the block id does not skip.
    TriggerIgnored,
    /// A frame without a trigger follows, a third of a period off, with a block id of its own.
    ExtraFrame,
    /// The block ids skip some without a lost frame.
    IdJump,
    /// The whole frame is sent again with the same id.
    RepeatedFrame,
    /// The camera's clock starts anew.
    ClockReset,
    /// Several frames in a row are exposed and never sent.
    Stall,
    /// The frame's timestamp is wrong by 60 ms or more.
    StampGlitch,
    /// The timestamp is 3 ms late: it may lie where a frame without a trigger would.
    StampNear,
    /// The frame has no timestamp: it is 0.
    StampAbsent,
    /// The frame is of another pixel format, or its leader states another.
    WrongFormat,
    PaddedRows,
    ChunksAppended,
    /// Every packet of the frame is four bytes shorter than requested.
    ShortPackets,
    /// The camera has no power for some triggers; then it is as it always is after power-on.
    Unplugged,
    /// Another client takes control of the camera, and gives it back after some triggers.
    ControlTaken,
    /// For some triggers the camera's registers hold what its description has no word for: a state of PTP that is none,
    /// an image without columns.
    Nonsense,
    /// Another client asks, tells and babbles on the control channel, without any right to.
    RogueClient,
    /// Stream packets with the ids of frames far away come from a foreign address.
    ForeignFar,
    /// A stream packet with the id of a frame that is soon to come comes from a foreign address.
    ForeignAhead,
    /// Another program at the camera's own address sends the frame with other pixels and another stamp.
    ForeignPixels,
    /// Small datagrams that are no packets come to the stream's port from other ports, the camera's address among
    /// theirs.
    ForeignSmall,
}

const RESENDS: [Resend; 4] = [Resend::Answered, Resend::Refused, Resend::Ignored, Resend::Late];
const PARTS: [Part; 4] = [Part::Packet, Part::Burst, Part::Leader, Part::Trailer];

impl Kind {
    /// The kinds that "all" stands for: each concerns one trigger, or a few.
    pub fn all() -> Vec<Kind> {
        let mut kinds = vec![Kind::FrameLost];
        kinds.extend(PARTS.iter().flat_map(|part| RESENDS.iter().map(|resend| Kind::Lost(*part, *resend))));
        kinds.extend([
            Kind::Reordered,
            Kind::Duplicated,
            Kind::Truncated,
            Kind::Malformed,
            Kind::TriggerIgnored,
            Kind::ExtraFrame,
            Kind::IdJump,
            Kind::RepeatedFrame,
            Kind::ClockReset,
            Kind::Stall,
            Kind::StampGlitch,
            Kind::StampNear,
            Kind::StampAbsent,
            Kind::WrongFormat,
            Kind::PaddedRows,
            Kind::ChunksAppended,
            Kind::ShortPackets,
        ]);
        kinds
    }

    /// Kinds that only happen where they are named: they cost a camera many triggers, or come from a third party.
    pub const APART: [Kind; 8] = [
        Kind::Unplugged,
        Kind::ControlTaken,
        Kind::Nonsense,
        Kind::RogueClient,
        Kind::ForeignFar,
        Kind::ForeignAhead,
        Kind::ForeignPixels,
        Kind::ForeignSmall,
    ];

    /// Whether another program sends to the stream's port.
    pub fn is_foreign(self) -> bool {
        matches!(self, Kind::ForeignFar | Kind::ForeignAhead | Kind::ForeignPixels | Kind::ForeignSmall)
    }

    /// Whether the camera is away from its node for a while.
    pub fn is_absence(self) -> bool {
        matches!(self, Kind::Unplugged | Kind::ControlTaken)
    }

    /// The kind of this name.
    pub fn parse(name: &str) -> Option<Kind> {
        Kind::all().into_iter().chain(Kind::APART).find(|kind| kind.to_string() == name)
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = match self {
            Kind::Lost(part, resend) => {
                let part = match part {
                    Part::Packet => "packet",
                    Part::Burst => "burst",
                    Part::Leader => "leader",
                    Part::Trailer => "trailer",
                };
                let resend = match resend {
                    Resend::Answered => "answered",
                    Resend::Refused => "refused",
                    Resend::Ignored => "ignored",
                    Resend::Late => "late",
                };
                return write!(f, "{part}_lost_{resend}");
            }
            Kind::FrameLost => "frame_lost",
            Kind::Reordered => "reordered",
            Kind::Duplicated => "duplicated",
            Kind::Truncated => "truncated",
            Kind::Malformed => "malformed",
            Kind::TriggerIgnored => "trigger_ignored",
            Kind::ExtraFrame => "extra_frame",
            Kind::IdJump => "id_jump",
            Kind::RepeatedFrame => "repeated_frame",
            Kind::ClockReset => "clock_reset",
            Kind::Stall => "stall",
            Kind::StampGlitch => "stamp_glitch",
            Kind::StampNear => "stamp_near",
            Kind::StampAbsent => "stamp_absent",
            Kind::WrongFormat => "wrong_format",
            Kind::PaddedRows => "padded_rows",
            Kind::ChunksAppended => "chunks_appended",
            Kind::ShortPackets => "short_packets",
            Kind::Unplugged => "unplugged",
            Kind::ControlTaken => "control_taken",
            Kind::Nonsense => "nonsense",
            Kind::RogueClient => "rogue_client",
            Kind::ForeignFar => "foreign_far",
            Kind::ForeignAhead => "foreign_ahead",
            Kind::ForeignPixels => "foreign_pixels",
            Kind::ForeignSmall => "foreign_small",
        };
        f.write_str(name)
    }
}

/// Why a plan cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("[faults] {0}")]
pub struct PlanError(pub String);

/// The faults to inject: by chance with a seed, and at stated triggers.
#[derive(Debug, Clone, PartialEq)]
pub struct FaultPlan {
    /// Decides everything that is left to chance.
    pub seed: u64,
    /// Probability per frame, by kind; kinds that are not named do not happen.
    pub probability: BTreeMap<Kind, f64>,
    /// No fault before this trigger.
    pub first_trigger: i64,
    /// Number of triggers without a fault at least, after each fault of a camera: what several faults in one row
    /// look like from outside cannot always be distinguished (`docs/design/acquisition.md`).
    pub clear_triggers: i64,
    /// The same after a reset of the clock, which costs the receiver its idea of it.
    pub clear_after_reset: i64,
    /// Most triggers that a stall lasts, and most ids that a jump skips; at least 2.
    pub longest: u64,
    /// How late a late answer is.
    pub late: Duration,
    /// Fewest and most triggers that a camera is away, where the plan does not state a number.
    pub absence: (u64, u64),
    /// Faults at stated triggers, beside those of chance, by camera and trigger.
    pub named: BTreeMap<(String, i64), NamedFault>,
    /// Faults of the HSU and its lines.
    pub hsu: HsuPlan,
}

/// A fault that the plan names.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NamedFault {
    pub kind: Kind,
    /// To how many triggers (ids, for a jump), for kinds that last.
    pub count: Option<u64>,
}

impl Default for FaultPlan {
    fn default() -> Self {
        Self {
            seed: 0,
            probability: BTreeMap::new(),
            first_trigger: 8,
            clear_triggers: 3,
            clear_after_reset: 24,
            longest: 5,
            late: Duration::from_millis(250),
            absence: (40, 120),
            named: BTreeMap::new(),
            hsu: HsuPlan::default(),
        }
    }
}

impl FaultPlan {
    /// Every kind with the same probability per frame.
    pub fn mixed(seed: u64, probability: f64) -> Self {
        let probability = Kind::all().into_iter().map(|kind| (kind, probability)).collect();
        Self { seed, probability, ..Self::default() }
    }

    /// Reads the tables `[faults]`, `[hsu]` and `[[fault]]` of a TOML text.
    ///
    /// # Errors
    /// Text that is no TOML, an unknown key, a number out of range.
    pub fn parse(text: &str) -> Result<Self, PlanError> {
        let file: PlanFile = toml::from_str(text).map_err(|e| PlanError(e.to_string()))?;
        let table = file.faults;
        let defaults = Self::default();
        let mut plan = Self {
            seed: table.seed,
            probability: BTreeMap::new(),
            first_trigger: table.first_trigger.unwrap_or(defaults.first_trigger),
            clear_triggers: table.clear_triggers.unwrap_or(defaults.clear_triggers),
            clear_after_reset: table.clear_after_reset.unwrap_or(defaults.clear_after_reset),
            longest: table.longest.unwrap_or(defaults.longest),
            late: table.late_ms.map_or(defaults.late, Duration::from_millis),
            absence: table.absence_triggers.map_or(defaults.absence, |[least, most]| (least, most)),
            named: BTreeMap::new(),
            hsu: HsuPlan::of_table(&file.hsu, table.seed)?,
        };
        if !(1..=plan.absence.1).contains(&plan.absence.0) || plan.absence.1 > 1_000_000 {
            let found = plan.absence;
            return Err(PlanError(format!("absence_triggers: expected two rising numbers, found {found:?}")));
        }
        for fault in file.fault {
            let kind = Kind::parse(&fault.kind).ok_or_else(|| unknown(&fault.kind))?;
            if fault.trigger < 0 || fault.count.is_some_and(|count| !(1..=1_000_000).contains(&count)) {
                let message =
                    format!("{} of {}: expected a trigger and a count above 0", fault.kind, fault.camera);
                return Err(PlanError(message));
            }
            let named = NamedFault { kind, count: fault.count };
            if plan.named.insert((fault.camera.clone(), fault.trigger), named).is_some() {
                return Err(PlanError(format!(
                    "two faults of {} at trigger {}",
                    fault.camera, fault.trigger
                )));
            }
        }
        let limits = [plan.first_trigger, plan.clear_triggers, plan.clear_after_reset];
        if limits.iter().any(|limit| !(0..=1_000_000).contains(limit)) || !(2..=1000).contains(&plan.longest)
        {
            let message = "expected first_trigger and clear_* within 0..=1000000, longest within 2..=1000";
            return Err(PlanError(message.to_owned()));
        }
        for (name, probability) in &table.probability {
            let kinds = match name.as_str() {
                "all" => Kind::all(),
                name => vec![Kind::parse(name).ok_or_else(|| unknown(name))?],
            };
            for kind in kinds {
                // A kind that is named has its own probability, beside that of "all".
                if name != "all" || !table.probability.contains_key(&kind.to_string()) {
                    plan.probability.insert(kind, *probability);
                }
            }
        }
        let sum: f64 = plan.probability.values().sum();
        if plan.probability.values().any(|p| !(0.0..=1.0).contains(p)) || sum > 1.0 {
            return Err(PlanError(format!(
                "probabilities must be 0 to 1 and their sum at most 1, found {sum}"
            )));
        }
        Ok(plan)
    }

    /// Whether any of its faults comes from another client.
    pub fn needs_stranger(&self) -> bool {
        let alone = [Kind::Unplugged, Kind::Nonsense];
        let stranger = |kind: &Kind| Kind::APART.contains(kind) && !alone.contains(kind);
        self.probability.keys().any(stranger) || self.named.values().any(|named| stranger(&named.kind))
    }

    /// Sets the seed of everything.
    pub fn set_seed(&mut self, seed: u64) {
        (self.seed, self.hsu.line.seed) = (seed, seed);
    }

    fn chance(&self, camera: u64, trigger: i64) -> u64 {
        hash(self.seed, &[camera, trigger as u64, 2])
    }

    /// The fault that chance gives one trigger of one camera, whatever happened before.
    fn draw(&self, camera: u64, trigger: i64) -> Option<(Kind, u64)> {
        let mut uniform = share(hash(self.seed, &[camera, trigger as u64, 1]));
        for (kind, probability) in &self.probability {
            if uniform < *probability {
                return Some((*kind, self.chance(camera, trigger)));
            }
            uniform -= probability;
        }
        None
    }
}

fn unknown(name: &str) -> PlanError {
    let known: Vec<String> = Kind::all().iter().chain(&Kind::APART).map(Kind::to_string).collect();
    PlanError(format!("kind {name:?}: expected \"all\" or one of {}", known.join(", ")))
}

#[derive(serde::Deserialize)]
struct PlanFile {
    faults: PlanTable,
    #[serde(default)]
    hsu: HsuTable,
    #[serde(default)]
    fault: Vec<NamedTable>,
}

#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct NamedTable {
    kind: String,
    camera: String,
    trigger: i64,
    count: Option<u64>,
}

#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct PlanTable {
    seed: u64,
    #[serde(default)]
    probability: BTreeMap<String, f64>,
    first_trigger: Option<i64>,
    clear_triggers: Option<i64>,
    clear_after_reset: Option<i64>,
    longest: Option<u64>,
    late_ms: Option<u64>,
    absence_triggers: Option<[u64; 2]>,
}

/// One fault at one trigger.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fault {
    pub kind: Kind,
    /// Decides the details: which packet, how many.
    pub chance: u64,
    /// How many triggers (ids, for a jump), for kinds that last.
    pub count: u64,
}

impl Fault {
    /// A fault of this kind; `count` where it is stated, else by chance.
    pub fn new(plan: &FaultPlan, kind: Kind, chance: u64, count: Option<u64>) -> Self {
        let by_chance = |from: u64, to: u64| from + chance % (to.saturating_sub(from) + 1);
        let count = count.unwrap_or_else(|| match kind {
            Kind::Stall => by_chance(2, plan.longest),
            Kind::IdJump => by_chance(1, plan.longest),
            // Aravis follows an id that is up to 100 ahead. The frame that it makes of it must have been given up
            // before the real one comes: no receiver can tell their packets apart (docs/design/faults.md).
            Kind::ForeignAhead => by_chance(24, 60),
            kind if kind.is_absence() || kind == Kind::Nonsense => by_chance(plan.absence.0, plan.absence.1),
            _ => 1,
        });
        Self { kind, chance, count }
    }
}

/// The plan of one camera during one train; queried for every trigger in order.
#[derive(Debug, Clone)]
pub struct CameraPlan {
    camera: u64,
    name: String,
    /// No new fault before this trigger.
    clear_until: i64,
    /// Before this trigger the stall lasts.
    stalled_until: i64,
}

impl CameraPlan {
    /// Of the camera of this name.
    pub fn new(camera: &str) -> Self {
        Self { camera: text_number(camera), name: camera.to_owned(), clear_until: 0, stalled_until: 0 }
    }

    /// The fault at this trigger. Triggers below 0 are warm-up and have none.
    pub fn fault(&mut self, plan: &FaultPlan, trigger: i64) -> Option<Fault> {
        let named = if plan.named.is_empty() {
            None
        } else {
            plan.named.get(&(self.name.clone(), trigger)).map(|named| (named.kind, named.count))
        };
        if named.is_none() && (0..self.stalled_until).contains(&trigger) {
            return Some(Fault { kind: Kind::Stall, chance: 0, count: 1 });
        }
        let early = trigger < 0 || trigger < plan.first_trigger || trigger < self.clear_until;
        let (kind, chance, count) = match named {
            Some((kind, count)) => (kind, plan.chance(self.camera, trigger), count),
            None if early => return None,
            None => plan.draw(self.camera, trigger).map(|(kind, chance)| (kind, chance, None))?,
        };
        let fault = Fault::new(plan, kind, chance, count);
        let (lasts, clear) = match kind {
            Kind::ForeignAhead => (fault.count as i64 + 1, plan.clear_triggers),
            Kind::Stall | Kind::Unplugged | Kind::ControlTaken | Kind::Nonsense => {
                (fault.count as i64, plan.clear_triggers)
            }
            Kind::ClockReset => (1, plan.clear_after_reset),
            _ => (1, plan.clear_triggers),
        };
        if kind == Kind::Stall {
            self.stalled_until = trigger.saturating_add(lasts);
        }
        self.clear_until = self.clear_until.max(trigger.saturating_add(lasts).saturating_add(clear));
        Some(fault)
    }

    /// The camera was away until this trigger: its clock and ids are new.
    pub fn returned(&mut self, plan: &FaultPlan, trigger: i64) {
        self.clear_until = self.clear_until.max(trigger.saturating_add(plan.clear_after_reset));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn train(plan: &FaultPlan, camera: &str) -> Vec<(i64, Fault)> {
        let mut state = CameraPlan::new(camera);
        (-50..5000).filter_map(|t| state.fault(plan, t).map(|fault| (t, fault))).collect()
    }

    #[test]
    fn faults_depend_on_seed_and_camera_and_keep_their_distance() {
        let plan = FaultPlan::mixed(7, 0.02);
        let faults = train(&plan, "h0_up");
        assert_eq!(faults, train(&plan, "h0_up"));
        assert_ne!(faults, train(&plan, "h0_low"));
        assert_ne!(faults, train(&FaultPlan::mixed(8, 0.02), "h0_up"));
        assert!(faults[0].0 >= plan.first_trigger);
        for pair in faults.windows(2) {
            let stalled = (pair[0].1.kind, pair[1].1.kind) == (Kind::Stall, Kind::Stall);
            assert!(pair[1].0 - pair[0].0 > plan.clear_triggers || stalled, "{pair:?}");
        }
        let kinds: std::collections::BTreeSet<Kind> = faults.iter().map(|(_, fault)| fault.kind).collect();
        assert_eq!(kinds.len(), Kind::all().len(), "5000 triggers show every kind");
    }

    #[test]
    fn names_are_names_and_wrong_plans_are_refused() {
        assert!(
            Kind::all().iter().chain(&Kind::APART).all(|kind| Kind::parse(&kind.to_string()) == Some(*kind))
        );
        let plan = FaultPlan::parse("[faults]\nseed = 3\n[faults.probability]\nall = 0.01\nstall = 0.0\n");
        let plan = plan.expect("a valid plan");
        assert_eq!((plan.probability[&Kind::Stall], plan.probability[&Kind::FrameLost]), (0.0, 0.01));
        for wrong in ["all = 0.5", "no_such = 0.1", "stall = -0.1", "stall = nan"] {
            let text = format!("[faults]\nseed = 3\n[faults.probability]\n{wrong}\n");
            assert!(FaultPlan::parse(&text).is_err(), "{wrong}");
        }
        assert!(FaultPlan::parse("[faults]\nseed = 1\nlongest = 1\n[faults.probability]\n").is_err());
        let missing = "[faults]\nseed = 1\nabsence_triggers = [9, 3]\n";
        assert!(FaultPlan::parse(missing).is_err());
        let shipped = include_str!("../../../config/scenarios/faults.toml");
        assert_eq!(FaultPlan::parse(shipped).expect("shipped").probability.len(), Kind::all().len());
    }

    #[test]
    fn a_fault_that_is_named_happens_exactly_there() {
        let text = "[faults]\nseed = 3\n[faults.probability]\nframe_lost = 0.3\n\
            [[fault]]\nkind = \"stall\"\ncamera = \"h0_up\"\ntrigger = 3\ncount = 4\n\
            [[fault]]\nkind = \"unplugged\"\ncamera = \"h0_up\"\ntrigger = 100\n";
        let plan = FaultPlan::parse(text).expect("valid");
        let faults = train(&plan, "h0_up");
        let stall: Vec<i64> = faults.iter().filter(|(_, f)| f.kind == Kind::Stall).map(|(t, _)| *t).collect();
        assert_eq!(stall, [3, 4, 5, 6], "before first_trigger, and for as long as is stated");
        let absence = faults.iter().position(|(_, f)| f.kind == Kind::Unplugged).expect("named");
        let (at, fault) = faults[absence];
        assert_eq!(at, 100);
        assert!((plan.absence.0..=plan.absence.1).contains(&fault.count), "as long as chance says");
        assert!(faults[absence + 1].0 >= 100 + fault.count as i64 + plan.clear_triggers);
        assert!(train(&plan, "h1_up").iter().all(|(_, f)| f.kind == Kind::FrameLost));
        for wrong in [
            "kind = \"no_such\"\ncamera = \"c\"\ntrigger = 1",
            "kind = \"stall\"\ncamera = \"c\"\ntrigger = -1",
            "kind = \"stall\"\ncamera = \"c\"\ntrigger = 1\ncount = 0",
            "kind = \"stall\"\ncamera = \"c\"",
        ] {
            assert!(
                FaultPlan::parse(&format!("[faults]\nseed = 3\n[[fault]]\n{wrong}\n")).is_err(),
                "{wrong}"
            );
        }
    }
}
