// SPDX-License-Identifier: MIT OR Apache-2.0
//! Histories in which a source slips by whole periods: the counter, the timestamps, the camera's clock, the HSU's
//! times.

use super::history::{Arrives, HOST_MINUS_HSU_NS, History, Random, Report, Traits};
use crate::base::ids::BlockId;

/// The source that slips in a test.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Source {
    Counter,
    /// Timestamps of frames; readings of the clock stay right.
    Stamps,
    /// The camera's clock, timestamps and readings alike.
    Clock,
    /// The times of the HSU's reports.
    Hsu,
}

/// A source that is some periods off, from one trigger on, for a while or for good.
#[derive(Debug, Clone, Copy)]
pub struct Slip {
    pub source: Source,
    pub periods: i64,
    pub from: i64,
    pub until: i64,
}

/// What the camera did just before the slip.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Before {
    Nothing,
    Lost(i64),
    Ignored(i64),
}

/// The part of the host that stands still.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stall {
    /// The thread that receives the camera's packets: they get their time of arrival late.
    Receiver,
    /// The thread that matches: what arrived has its time, but is looked at late.
    Recorder,
    /// The thread of the HSU's link.
    Link,
    All,
}

#[derive(Debug, Clone)]
pub struct Plan {
    pub slips: Vec<Slip>,
    pub before: Before,
    pub stalls: Vec<(u64, u64, Stall)>,
}

const STALL_MAX_NS: u64 = 300_000_000;

impl Plan {
    /// How many periods counter and clock are off, both alike: then they agree with each other, and only the arrivals
    /// can tell. A camera that ignored triggers is behind by its counter.
    pub fn alike(&self) -> i64 {
        let from = self.slips.first().map_or(0, |slip| slip.from);
        let behind = match self.before {
            Before::Ignored(count) => count.min(from + 8),
            // What is lost before the first frame cannot be known.
            Before::Lost(count) if from - count <= -8 => from + 8,
            _ => 0,
        };
        let of = |sources: &[Source]| -> i64 {
            self.slips.iter().filter(|slip| sources.contains(&slip.source)).map(|slip| slip.periods).sum()
        };
        let (counter, clock) = (of(&[Source::Counter]) - behind, of(&[Source::Stamps, Source::Clock]));
        // What slips in the warm-up is taken for right there, and is off by as much when it is over.
        let early = self.slips.iter().any(|slip| slip.from < 0);
        if counter == clock || (early && counter == -clock) { counter } else { 0 }
    }

    /// Nothing but the host, which stands still.
    pub fn stalls_only(seed: u64, history: &History) -> Self {
        Self { slips: Vec::new(), before: Before::Nothing, ..Self::any(seed, history) }
    }

    /// Whether nothing stands still in the warm-up.
    pub fn begins_calmly(&self, history: &History) -> bool {
        let begins = history.fired().iter().find(|(number, _)| *number == 4).map_or(0, |(_, ns)| *ns);
        self.stalls.iter().all(|(from, ..)| *from > begins)
    }

    /// One slip or two at once, whatever came before them, and a host that stands still one to four times.
    pub fn any(seed: u64, history: &History) -> Self {
        let mut random = Random::new(seed ^ 0x0051_1bb5);
        let triggers = history.fired().last().map_or(0, |(number, _)| *number);
        let early = random.one_in(4);
        let from =
            if early { -8 + random.below(12) as i64 } else { random.below(triggers as u64 - 20) as i64 };
        let until = if random.one_in(2) { i64::MAX } else { from + 1 + random.below(12) as i64 };
        let periods = |random: &mut Random| {
            let size = 1 + random.below(2) as i64;
            if random.one_in(2) { size } else { -size }
        };
        let source = |random: &mut Random| {
            [Source::Counter, Source::Stamps, Source::Clock, Source::Hsu][random.below(4) as usize]
        };
        let first = Slip { source: source(&mut random), periods: periods(&mut random), from, until };
        let mut slips = vec![first];
        if random.one_in(3) {
            let second = Slip { source: source(&mut random), ..first };
            let periods = if random.one_in(2) { first.periods } else { periods(&mut random) };
            if second.source != first.source {
                slips.push(Slip { periods, ..second });
            }
        }
        let before = match random.below(6) {
            0 | 1 => Before::Lost(1 + random.below(2) as i64),
            2 => Before::Ignored(1 + random.below(2) as i64),
            _ => Before::Nothing,
        };
        let fired = history.fired();
        let (begin, end) = (fired[0].1, fired[fired.len() - 1].1);
        let slip_ns = fired.iter().find(|(number, _)| *number == from).map_or(begin, |(_, ns)| *ns);
        let mut stalls = Vec::new();
        for _ in 0..1 + random.below(4) {
            let kind = [Stall::Receiver, Stall::Recorder, Stall::Link, Stall::All][random.below(4) as usize];
            let length = random.below(STALL_MAX_NS);
            // Often about the slip.
            let start = match random.one_in(2) {
                true => (slip_ns + random.below(2 * history.period_ns))
                    .saturating_sub(random.below(length.max(1))),
                false => begin + random.below(end - begin),
            };
            stalls.push((start, start + length, kind));
        }
        Self { slips, before, stalls }
    }
}

impl History {
    /// Number and time of each trigger.
    pub fn fired(&self) -> Vec<(i64, u64)> {
        let mut fired: Vec<(i64, u64)> = self
            .arrivals
            .iter()
            .filter_map(|(_, what)| match what {
                Arrives::Report(report) => Some((report.number, report.hsu_ns)),
                _ => None,
            })
            .collect();
        fired.sort_unstable();
        fired
    }

    /// With what a plan does to it.
    pub fn with(mut self, plan: &Plan) -> Self {
        self.forget(plan);
        for slip in &plan.slips {
            self.slip(*slip);
        }
        for &(from, until, kind) in &plan.stalls {
            self.stall(from, until, kind);
        }
        self
    }

    fn forget(&mut self, plan: &Plan) {
        let from = plan.slips.first().map_or(0, |slip| slip.from);
        let (count, ignored) = match plan.before {
            Before::Nothing => return,
            Before::Lost(count) => (count, false),
            Before::Ignored(count) => (count, true),
        };
        let gone = from - count..from;
        self.arrivals
            .retain(|(_, what)| !matches!(what, Arrives::Frame(_, Some(number)) if gone.contains(number)));
        if ignored {
            self.shift_ids(from, i64::MAX, -count.min(from + 8));
        }
    }

    fn shift_ids(&mut self, from: i64, until: i64, by: i64) {
        for (_, what) in &mut self.arrivals {
            if let Arrives::Frame(frame, Some(number)) = what
                && (from..until).contains(number)
            {
                frame.id = shifted(frame.id, by, self.traits.wide);
            }
        }
    }

    fn slip(&mut self, Slip { source, periods, from, until }: Slip) {
        let by = i128::from(periods) * i128::from(self.period_ns);
        let moved = |ns: u64| u64::try_from(i128::from(ns) + by).unwrap_or(0);
        let fired = self.fired();
        let at = |wanted: i64| fired.iter().find(|(number, _)| *number >= wanted).map(|(_, ns)| *ns);
        let (begin, end) = (at(from).unwrap_or(u64::MAX), at(until).unwrap_or(u64::MAX));
        match source {
            Source::Counter => self.shift_ids(from, until, periods),
            Source::Hsu => {
                for (_, what) in &mut self.arrivals {
                    if let Arrives::Report(Report { number, hsu_ns, .. }) = what
                        && (from..until).contains(number)
                    {
                        *hsu_ns = moved(*hsu_ns);
                    }
                }
            }
            Source::Stamps | Source::Clock => {
                for (at, what) in &mut self.arrivals {
                    match what {
                        Arrives::Frame(frame, Some(number)) if (from..until).contains(number) => {
                            frame.camera_ns = frame.camera_ns.map(moved);
                        }
                        Arrives::Clock(exchange) if source == Source::Clock && (begin..end).contains(at) => {
                            exchange.device_ns = moved(exchange.device_ns);
                        }
                        _ => {}
                    }
                }
                if source == Source::Clock {
                    self.set_clock(begin, end, by);
                }
            }
        }
    }

    fn set_clock(&mut self, begin: u64, end: u64, by: i128) {
        let before = self.clocks.last().map_or(0, |(_, ns)| *ns);
        self.clocks.push((begin, before + by));
        if end != u64::MAX {
            self.clocks.push((end, before));
        }
    }

    /// What comes from one thread stays in order.
    fn stall(&mut self, from: u64, until: u64, kind: Stall) {
        let (mut frames_ns, mut reports_ns, mut all_ns) = (0, 0, 0);
        for (at, what) in &mut self.arrivals {
            let window = from..until;
            let receiver = matches!(kind, Stall::Receiver | Stall::All);
            let link = matches!(kind, Stall::Link | Stall::All);
            let stands = window.contains(at);
            match what {
                Arrives::Frame(frame, _) | Arrives::Copy(frame, _) => {
                    let came = (i128::from(frame.host_ns) - HOST_MINUS_HSU_NS) as u64;
                    let comes = if receiver && window.contains(&came) { until } else { came };
                    let comes = comes.max(frames_ns + 1_000);
                    frame.host_ns += comes - came;
                    *at = comes.max(*at);
                    frames_ns = comes;
                }
                Arrives::Report(report) => {
                    let stands = link && window.contains(&report.heard_ns);
                    let heard = if stands { until } else { report.heard_ns };
                    report.heard_ns = heard.max(reports_ns + 1_000);
                    *at = report.heard_ns.max(*at);
                    reports_ns = report.heard_ns;
                }
                Arrives::Hsu(exchange) | Arrives::Clock(exchange) if link && stands => {
                    exchange.host_receive_ns += until - *at;
                    *at = until;
                }
                _ => {}
            }
            if kind == Stall::Recorder && *at >= from {
                *at = if stands { until } else { *at }.max(all_ns + 1_000);
                all_ns = *at;
            }
        }
        self.arrivals.sort_by_key(|(at, _)| *at);
    }
}

fn shifted(id: BlockId, by: i64, wide: bool) -> BlockId {
    if wide {
        return BlockId(id.0.saturating_add_signed(by).max(70_000));
    }
    BlockId(((id.0 as i64 - 1 + by).rem_euclid(65_535) + 1) as u64)
}

/// A camera without other faults.
pub fn plain(seed: u64) -> History {
    History::of(seed, Traits { faults: false, ..Traits::any(seed) })
}
