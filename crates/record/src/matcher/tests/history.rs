// SPDX-License-Identifier: MIT OR Apache-2.0
//! Histories of one camera: its habits, what happens to it, and what the node sees of it.

use crate::base::clock_fit::Exchange;
use crate::base::ids::BlockId;
use crate::matcher::sighting::Sighting;
use hsu_firmware_proto::PAUSE_BEFORE;

/// The host's clock minus the HSU's, ns.
pub const HOST_MINUS_HSU_NS: i128 = 1_790_000_000_000_000_000;
const HSU_NS: u64 = 3_000_000_000;

pub struct Random(u64);

impl Random {
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 16
    }

    pub fn below(&mut self, bound: u64) -> u64 {
        self.next() % bound.max(1)
    }

    pub fn one_in(&mut self, n: u64) -> bool {
        self.below(n) == 0
    }
}

/// How a simulated camera numbers, stamps and sends its frames.
#[derive(Debug, Clone, Copy)]
pub struct Traits {
    pub wide: bool,
    pub stamps: bool,
    /// Its clock can be read.
    pub clock: bool,
    /// From trigger to timestamp, in hundredths of a period: start of exposure, its end, readout.
    pub stamp_delay: u64,
    /// From trigger to first packet, in hundredths of a period.
    pub arrival_delay: u64,
    /// Of the timestamps, in thousandths of a period.
    pub jitter: u64,
    /// The host takes packets off the socket so far apart, ns; 0: at once.
    pub batch_ns: u64,
    pub faults: bool,
    /// The host is busy: most frames are taken up at once, a third within a period, some later. Faults keep a distance
    /// of twelve triggers then, as those of the laboratory's plans do.
    pub busy: bool,
    /// For spells of some dozen frames the host takes each up when it gets to it, within two and a half periods.
    pub spells: bool,
}

impl Traits {
    pub fn any(seed: u64) -> Self {
        let mut random = Random::new(seed ^ 0x5eed);
        Self {
            wide: random.one_in(2),
            stamps: !random.one_in(6),
            clock: !random.one_in(4),
            stamp_delay: random.below(250),
            arrival_delay: 5 + random.below(295),
            jitter: random.below(20),
            batch_ns: if random.one_in(3) { 5_000_000 } else { 0 },
            faults: true,
            busy: false,
            spells: random.one_in(3),
        }
    }
}

/// What the HSU reports of a trigger.
#[derive(Debug, Clone, Copy)]
pub struct Report {
    pub number: i64,
    pub hsu_ns: u64,
    /// Whether the HSU flags it as late.
    pub late: bool,
    /// When the link's thread received it, HSU clock, ns.
    pub heard_ns: u64,
}

/// Something that reaches the node: a report, a frame or a reading.
#[derive(Debug, Clone, Copy)]
pub enum Arrives {
    Report(Report),
    /// With its true trigger; `None` where it has none.
    Frame(Sighting, Option<i64>),
    /// The frame of that trigger once more.
    Copy(Sighting, i64),
    Hsu(Exchange),
    Clock(Exchange),
    /// The camera is back, with a fresh stream.
    Back,
}

pub struct History {
    pub traits: Traits,
    pub period_ns: u64,
    pub warm_up: u32,
    /// Whether the warm-up went well.
    pub calm_start: bool,
    /// Whether the link to the HSU stood still for a while.
    pub link_stands: bool,
    /// The camera's clock minus the HSU's, ns, from these HSU times on, and its drift, ppm.
    pub clocks: Vec<(u64, i128)>,
    pub ppm: f64,
    /// In the order in which it arrives, with when, HSU clock, ns.
    pub arrivals: Vec<(u64, Arrives)>,
}

struct Camera {
    random: Random,
    traits: Traits,
    period_ns: u64,
    id: u64,
    /// Its clock minus the HSU's.
    clock_ns: i128,
    ppm: f64,
    /// No frame arrives before this, HSU clock, ns: the host stands still.
    stalled_ns: u64,
    /// Frames that the busy spell still lasts, and within what they are taken up, ns.
    spell: (u64, u64),
    last_ns: u64,
    clocks: Vec<(u64, i128)>,
    arrivals: Vec<(u64, Arrives)>,
    /// Whether something happened at the last trigger.
    faulty: bool,
}

impl Camera {
    fn next_id(&mut self) -> BlockId {
        self.id += 1;
        BlockId(if self.traits.wide { 70_000 + self.id } else { (self.id - 1) % 65_535 + 1 })
    }

    fn shows(&self, hsu_ns: u64) -> u64 {
        shows(hsu_ns, self.clock_ns, self.ppm)
    }

    fn percent(&self, hundredths: u64) -> u64 {
        self.period_ns * hundredths / 100
    }

    fn stamp(&mut self, fired_ns: u64) -> Option<u64> {
        let jitter = self.random.below(1 + self.period_ns * self.traits.jitter / 1000);
        let at = fired_ns + self.percent(self.traits.stamp_delay) + jitter;
        self.traits.stamps.then(|| self.shows(at))
    }

    fn sighted(&mut self, fired_ns: u64, camera_ns: Option<u64>, complete: bool) -> Sighting {
        let jitter = self.random.below(self.period_ns / 30);
        let busy = match self.random.below(10) {
            _ if !self.traits.busy => 0,
            0 => self.random.below(2 * self.period_ns),
            1..=3 => self.random.below(self.period_ns * 7 / 10),
            _ => self.random.below(self.period_ns / 10),
        };
        let straggler = if self.traits.faults && self.random.one_in(200) {
            self.random.below(3 * self.period_ns)
        } else {
            0
        };
        let spell = match self.spell.0 {
            0 => 0,
            _ => self.random.below(self.spell.1),
        };
        self.spell.0 = self.spell.0.saturating_sub(1);
        let at = fired_ns + self.percent(self.traits.arrival_delay) + jitter + straggler + busy + spell;
        let at = at.max(self.stalled_ns).next_multiple_of(self.traits.batch_ns.max(1));
        self.last_ns = at.max(self.last_ns + 1_000);
        let host_ns = (i128::from(self.last_ns) + HOST_MINUS_HSU_NS) as u64;
        Sighting { id: self.next_id(), camera_ns, host_ns, complete }
    }

    fn send(&mut self, fired_ns: u64, number: i64) {
        let camera_ns = self.stamp(fired_ns);
        let frame = self.sighted(fired_ns, camera_ns, true);
        self.arrivals.push((self.last_ns, Arrives::Frame(frame, Some(number))));
    }

    fn exchange(&mut self, hsu_ns: u64) {
        let (out, back) = (self.random.below(200_000), self.random.below(200_000));
        let host = |ns: u64| (i128::from(ns) + HOST_MINUS_HSU_NS) as u64;
        let exchange = Exchange {
            host_send_ns: host(hsu_ns - out),
            host_receive_ns: host(hsu_ns + back),
            device_ns: self.shows(hsu_ns),
        };
        if self.traits.clock {
            self.arrivals.push((hsu_ns + back, Arrives::Clock(exchange)));
        }
    }

    /// One trigger, and whatever happens at it. Returns how many more of them the fault takes.
    fn trigger(&mut self, fired_ns: u64, number: i64, quiet: bool) -> i64 {
        let fault = if quiet { 99 } else { self.random.below(200) };
        self.faulty = fault <= 13;
        match fault {
            // Lost on the way.
            0 | 1 => {
                self.next_id();
                return self.random.below(4) as i64 * i64::from(self.random.one_in(2));
            }
            // Ignored by the camera.
            2 | 3 => {}
            // Its timestamp is wrong, by little, by much, by whole periods, or there is none.
            4..=6 => {
                let true_ns = self.stamp(fired_ns);
                let by = match self.random.below(4) {
                    0 => self.random.below(6 * self.period_ns),
                    1 => self.period_ns * self.random.below(4),
                    2 => self.random.below(1 << 50),
                    _ => 60_000_000,
                };
                let ahead = self.random.one_in(2);
                let wrong = true_ns.map(|ns| if ahead { ns.wrapping_add(by) } else { ns.wrapping_sub(by) });
                let wrong = match self.random.below(5) {
                    0 => None,
                    1 => true_ns.map(|_| u64::MAX),
                    _ => wrong,
                };
                let frame = self.sighted(fired_ns, wrong, true);
                self.arrivals.push((self.last_ns, Arrives::Frame(frame, Some(number))));
            }
            // Its clock is set: anyhow, or by whole periods.
            7 => {
                // Where arrivals do not tell one trigger from the next, or hardly, a clock that is set by a whole
                // period and a camera that ignores a trigger agree with each other.
                let mute = self.traits.batch_ns * 4 > self.period_ns * 3 || self.traits.busy;
                let by = match self.random.below(3) {
                    0 if !mute => i128::from(self.period_ns) * (1 + self.random.below(3) as i128),
                    _ => self.random.below(1 << 40) as i128,
                };
                self.clock_ns += if self.random.one_in(2) { by } else { -by };
                self.clocks.push((fired_ns, self.clock_ns));
                self.send(fired_ns, number);
            }
            // Ids jump without a loss, or stand still.
            8 => {
                self.id = self.id.wrapping_add(self.random.below(40));
                self.send(fired_ns, number);
            }
            9 => {
                self.id = self.id.saturating_sub(1).max(1);
                self.send(fired_ns, number);
            }
            // A frame that nothing triggered, between two triggers.
            10 => {
                self.send(fired_ns, number);
                let between = fired_ns + self.period_ns * (30 + self.random.below(40)) / 100;
                let camera_ns = self.stamp(between);
                let frame = self.sighted(between, camera_ns, true);
                self.arrivals.push((self.last_ns, Arrives::Frame(frame, None)));
            }
            // Torn.
            11 => {
                let camera_ns = self.stamp(fired_ns);
                let camera_ns = camera_ns.filter(|_| self.random.one_in(2));
                let frame = self.sighted(fired_ns, camera_ns, false);
                self.arrivals.push((self.last_ns, Arrives::Frame(frame, Some(number))));
            }
            // Twice.
            12 => {
                self.send(fired_ns, number);
                if let Some((_, Arrives::Frame(frame, _))) = self.arrivals.last().copied() {
                    self.arrivals.push((self.last_ns, Arrives::Copy(frame, number)));
                }
            }
            // The host stands still.
            13 => {
                self.stalled_ns = fired_ns + self.random.below(12 * self.period_ns);
                self.send(fired_ns, number);
            }
            _ => self.send(fired_ns, number),
        }
        0
    }
}

impl History {
    pub fn of(seed: u64, traits: Traits) -> Self {
        let mut random = Random::new(seed);
        let period_ns = [8_333_333, 20_000_000, 6_134_969, 2_500_000][random.below(4) as usize];
        let (warm_up, triggers) = (8i64, 100 + random.below(150) as i64);
        let ppm = random.below(200) as f64 - 100.0;
        let id = if random.one_in(2) { 0 } else { random.below(70_000) };
        let mut camera = Camera {
            traits,
            period_ns,
            id,
            clock_ns: 77_000_000_000_000,
            ppm,
            stalled_ns: 0,
            spell: (0, 0),
            last_ns: 0,
            clocks: vec![(0, 77_000_000_000_000)],
            arrivals: Vec::new(),
            faulty: false,
            random,
        };
        let first_ns = HSU_NS + 1_000_000_000;
        (0..16).for_each(|k| camera.exchange(first_ns - 500_000_000 + k * 1_000_000));
        let mut fired = vec![(first_ns, false)];
        for number in -warm_up + 1..triggers {
            let pause = if PAUSE_BEFORE.contains(&number) { period_ns / 2 } else { 0 };
            let held = if traits.faults && camera.random.one_in(300) {
                camera.random.below(3 * period_ns)
            } else {
                0
            };
            let before = fired.last().map_or(0, |(ns, _)| *ns);
            fired.push((before + period_ns + pause + held, held > period_ns / 16));
        }
        let absences = traits.faults && !traits.busy && camera.random.one_in(2);
        // In half of the histories the warm-up goes well.
        let calm_start = camera.random.one_in(2) || traits.busy;
        let (mut calm, mut skip, mut away) = (if calm_start { 12u64 } else { 0 }, 0, 0u64);
        for (k, &(fired_ns, late)) in fired.iter().enumerate() {
            let number = k as i64 - warm_up;
            let held = if traits.faults && camera.random.one_in(60) {
                camera.random.below(20 * period_ns)
            } else {
                0
            };
            let heard_ns = fired_ns + 500_000 + held;
            let report = Report { number, hsu_ns: fired_ns, late, heard_ns };
            camera.arrivals.push((heard_ns, Arrives::Report(report)));
            if (k + 1) % 60 == 0 && away == 0 {
                camera.exchange(fired_ns);
            }
            if away > 0 {
                away -= 1;
                if away == 0 {
                    camera.come_back(fired_ns);
                }
                continue;
            }
            if skip > 0 {
                skip -= 1;
                camera.next_id();
                continue;
            }
            if absences && calm == 0 && camera.random.one_in(120) {
                away = 4 + camera.random.below(40);
                calm = 12;
                continue;
            }
            if traits.spells && traits.faults && camera.spell.0 == 0 && camera.random.one_in(60) {
                camera.spell = (10 + camera.random.below(50), 1 + camera.random.below(5 * period_ns / 2));
            }
            let before = (camera.id, camera.arrivals.len());
            skip = camera.trigger(fired_ns, number, !traits.faults || calm > 0);
            let plain = (camera.id, camera.arrivals.len()) == (before.0 + 1, before.1 + 1);
            let distance = camera.random.below(12);
            calm = match () {
                () if traits.busy && camera.faulty => 12,
                () if plain => calm.saturating_sub(1),
                () => distance,
            };
        }
        let mut arrivals = camera.arrivals;
        let mut random = Random::new(seed ^ 0x11a5);
        let link_stands = traits.faults && !traits.busy && random.one_in(8);
        if link_stands {
            // The link to the HSU stands still for a while, often in the warm-up.
            let from = first_ns + random.below(2) * random.below(100 * period_ns);
            let until = from + random.below(80 * period_ns);
            let stands =
                |at: u64, what: &Arrives| (from..until).contains(&at) && matches!(what, Arrives::Report(..));
            for (at, what) in arrivals.iter_mut().filter(|(at, what)| stands(*at, what)) {
                *at = until;
                if let Arrives::Report(report) = what {
                    report.heard_ns = until;
                }
            }
        }
        let host = |ns: u64| (i128::from(ns) + HOST_MINUS_HSU_NS) as u64;
        for k in 0..40 {
            let at = first_ns - 700_000_000 + k * 100_000_000;
            let exchange = Exchange {
                host_send_ns: host(at - 90_000),
                host_receive_ns: host(at + 90_000),
                device_ns: at,
            };
            arrivals.push((at + 90_000, Arrives::Hsu(exchange)));
        }
        arrivals.sort_by_key(|(at, _)| *at);
        let clocks = camera.clocks;
        Self { traits, period_ns, warm_up: warm_up as u32, calm_start, link_stands, clocks, ppm, arrivals }
    }

    /// A reading of the camera's clock at an HSU time, with its round trip.
    pub fn read(&self, hsu_ns: u64, there_ns: u64, back_ns: u64) -> Exchange {
        let host = |ns: u64| (i128::from(ns) + HOST_MINUS_HSU_NS) as u64;
        let clock_ns = self.clocks.iter().rev().find(|(from, _)| *from <= hsu_ns).map_or(0, |(_, ns)| *ns);
        let device_ns = shows(hsu_ns, clock_ns, self.ppm);
        Exchange { host_send_ns: host(hsu_ns - there_ns), host_receive_ns: host(hsu_ns + back_ns), device_ns }
    }
}

fn shows(hsu_ns: u64, clock_ns: i128, ppm: f64) -> u64 {
    let drift = (hsu_ns - HSU_NS) as f64 * ppm * 1e-6;
    (i128::from(hsu_ns) + clock_ns + drift as i128).max(1) as u64
}

impl Camera {
    /// A fresh stream: ids begin anew, and the clock too where it was switched off. Its clock is read at once.
    fn come_back(&mut self, now_ns: u64) {
        self.id = 0;
        if self.random.one_in(2) {
            self.clock_ns = -i128::from(now_ns) + self.random.below(1 << 32) as i128;
            self.clocks.push((now_ns, self.clock_ns));
        }
        // What was sent before has arrived or never does.
        let at = now_ns.max(self.last_ns) + 1_000;
        self.last_ns = at;
        self.arrivals.push((at, Arrives::Back));
        (0..16).for_each(|k| self.exchange(at + 300_000 + k * 20_000));
    }
}
