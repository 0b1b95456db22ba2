// SPDX-License-Identifier: MIT OR Apache-2.0
//! A recording as plain data, made by a model of honest devices, and written by the writer that records sessions.

use crate::base::ids::{BlockId, CameraId, NodeId, SessionName, TriggerIndex};
use crate::layout::{
    CameraHeader, ClockSample, GapCause, HsuIdentity, NodeEvent, RecordingHeader, TriggerRecord, WarmUp,
};
use crate::verify::frame::Seen;
use crate::{ENVELOPE_CAPACITY, FrameMeta, Recording, SessionEnd, WriterOptions, node_dir, write_envelope};
use hsu_firmware_proto::{PAUSE_BEFORE, TriggerFlags};
use std::collections::BTreeMap;
use std::path::Path;

/// Time from trigger to trigger at 50 Hz, ns.
pub const PERIOD: i64 = 20_000_000;
pub const TRIGGERS: i64 = 240;
const SIDE: u32 = 4;
const WARM_UP: i64 = 8;
/// The host's clock minus the HSU's.
const HOST: i64 = 1_790_000_000_000_000_000;
/// The HSU's clock at the first warm-up trigger.
const FIRST: i64 = 30_000_000_000;
const MS: i64 = 1_000_000;

pub struct Random(pub u64);

impl Random {
    pub fn below(&mut self, bound: i64) -> i64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as i64 % bound.max(1)
    }
}

/// How a simulated camera stamps and sends its frames.
#[derive(Clone, Copy)]
pub struct Habits {
    pub name: &'static str,
    pub stamps: bool,
    pub clock: bool,
    /// From trigger to stamp and to arrival, hundredths of a period.
    pub stamp: i64,
    pub arrival: i64,
    /// The id before its first one.
    pub id: i64,
    pub wide: bool,
    pub ppm: i64,
}

pub const CAMERAS: [Habits; 4] = [
    Habits { name: "h0_up", stamps: true, clock: true, stamp: 5, arrival: 30, id: 0, wide: true, ppm: 50 },
    Habits {
        name: "h0_low",
        stamps: true,
        clock: false,
        stamp: 40,
        arrival: 45,
        id: 0,
        wide: false,
        ppm: -50,
    },
    Habits { name: "h1_up", stamps: false, clock: false, stamp: 0, arrival: 140, id: 0, wide: false, ppm: 0 },
    Habits {
        name: "h1_low",
        stamps: true,
        clock: true,
        stamp: 130,
        arrival: 150,
        id: 65_400,
        wide: false,
        ppm: -30,
    },
];

/// What happens in an honest session; of cameras to all, but each at triggers of its own.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Happens {
    Nothing,
    /// The host stands still now and then, for at most this many ms; or the threads of each camera by themselves.
    Pauses(i64),
    PausesOfEach(i64),
    /// Time between two reads of the sockets, ms.
    Batches(i64),
    /// Frames are lost on the way; or triggers ignored, in rows.
    Lost,
    Ignored,
    /// Frames that nothing triggered take an id.
    Extra,
    IdJump,
    IdRepeated,
    /// One stamp is wrong by a period, by a little, or absent.
    StampWrong(i64),
    StampAbsent,
    /// The clock is set, by so much.
    ClockSet(i64),
    /// The camera is away for a while; ids and clock begin anew.
    Away,
    /// Frames are given up, and ids stand elsewhere behind them.
    GivenUp,
    /// The HSU is late with some triggers, and flags them.
    Late,
    /// Time by which reports are held up, ms.
    ReportsHeldUp(i64),
    RowsLost,
    /// The camera takes every second trigger; wakes up behind the warm-up; misses trigger 0.
    EverySecond,
    WakesLate(i64),
    MissesFirst,
    /// The recording begins this many triggers behind the warm-up.
    BeforeRecord(i64),
    Endless,
}

/// A frame of a trigger.
pub type Frames = BTreeMap<i64, Seen>;

/// A recording that tests make and damage.
#[derive(Clone)]
pub struct Take {
    pub header: RecordingHeader,
    pub rows: Vec<TriggerRecord>,
    pub samples: Vec<ClockSample>,
    pub events: Vec<NodeEvent>,
    pub frames: Vec<Frames>,
    pub gaps: Vec<BTreeMap<i64, GapCause>>,
}

impl Take {
    pub fn honest(happens: Happens, seed: u64) -> Self {
        Model::new(happens, seed).take()
    }

    /// Writes it below a session's directory.
    pub fn write(&self, session: &Path) {
        let dir = node_dir(session, &self.header.node);
        let options = WriterOptions { reserve_bytes: 0, preallocate: false, ..WriterOptions::default() };
        let mut recording = Recording::create(&dir, self.header.clone(), options).expect("created");
        self.samples.iter().for_each(|sample| recording.clock_sample(sample).expect("written"));
        self.events.iter().for_each(|event| recording.event(event).expect("written"));
        self.rows.iter().for_each(|row| recording.trigger(row).expect("written"));
        let end = self.end();
        for (place, (frames, gaps)) in self.frames.iter().zip(&self.gaps).enumerate() {
            for trigger in 0..end {
                match frames.get(&trigger) {
                    Some(seen) => self.frame(&mut recording, place, trigger, seen),
                    None => {
                        let cause = gaps.get(&trigger).copied().unwrap_or(GapCause::MissingPackets);
                        recording.gap(place, TriggerIndex(trigger as u64), cause).expect("written");
                    }
                }
            }
        }
        let triggers_emitted = Some(end as u64).filter(|_| self.header.hsu.is_some());
        let end = SessionEnd { triggers_emitted, aborted: None, absent: GapCause::Unknown, host_time_ns: 0 };
        recording.finish(end).expect("finished");
    }

    fn end(&self) -> i64 {
        let frames = self.frames.iter().filter_map(|frames| frames.keys().next_back()).max();
        let rows = self.rows.iter().map(|row| row.index.0 as i64).max();
        frames.copied().into_iter().chain(rows).max().map_or(0, |last| last + 1)
    }

    fn frame(&self, recording: &mut Recording, place: usize, trigger: i64, seen: &Seen) {
        let pixels = [(trigger % 251) as u8; (SIDE * SIDE) as usize];
        let meta = FrameMeta {
            trigger: TriggerIndex(trigger as u64),
            block: BlockId(seen.block),
            camera_time_ns: seen.camera_ns,
            host_time_ns: seen.host_ns,
            width: SIDE,
            height: SIDE,
            pixels_crc: crc32fast::hash(&pixels),
        };
        let mut message = vec![0; ENVELOPE_CAPACITY];
        let length = write_envelope(&mut message, &self.header.cameras[place].id, &meta).expect("room");
        message.drain(..ENVELOPE_CAPACITY - length);
        message.extend_from_slice(&pixels);
        recording.frame(place, &meta, &message).expect("written");
    }
}

struct Model {
    happens: Happens,
    random: Random,
    /// When each trigger was fired, HSU clock, from the first of the warm-up.
    fired: Vec<i64>,
    take: Take,
    /// Times in which the whole host stands still, HSU clock.
    pauses: Vec<(i64, i64)>,
    /// Triggers of the train before trigger 0 of the recording.
    before: i64,
}

impl Model {
    fn new(happens: Happens, seed: u64) -> Self {
        let camera = |habits: &Habits| CameraHeader {
            id: CameraId::from(habits.name),
            width: SIDE,
            height: SIDE,
            device: "model".to_owned(),
            pixel_format: String::new(),
            settings: Vec::new(),
            state: BTreeMap::new(),
        };
        let before = if let Happens::BeforeRecord(before) = happens { before } else { 0 };
        let endless = matches!(happens, Happens::Endless | Happens::BeforeRecord(_));
        let header = RecordingHeader {
            session: SessionName::from("walk"),
            session_id: "5f0c".to_owned(),
            node: NodeId::from("a"),
            rig_text: String::new(),
            cameras: CAMERAS.iter().map(camera).collect(),
            hsu: Some(HsuIdentity::default()),
            expected_triggers: (!endless).then_some(TRIGGERS as u64),
            trigger_rate_hz: 50.0,
            host_clock: "CLOCK_REALTIME".to_owned(),
            created_ns: (HOST + FIRST - 2_000 * MS) as u64,
            software: "model".to_owned(),
            subject: None,
            note: None,
        };
        let none = || (0..CAMERAS.len()).map(|_| BTreeMap::new()).collect();
        let gaps = (0..CAMERAS.len()).map(|_| BTreeMap::new()).collect();
        let (rows, samples, events) = (Vec::new(), Vec::new(), Vec::new());
        let take = Take { header, rows, samples, events, frames: none(), gaps };
        let random = Random(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1);
        Self { happens, random, fired: Vec::new(), take, pauses: Vec::new(), before }
    }

    fn number(&self, place: usize) -> i64 {
        place as i64 - WARM_UP - self.before
    }

    fn event(&mut self, kind: &str, camera: Option<&str>, number: i64, message: &str) {
        let trigger = u64::try_from(number).ok().map(TriggerIndex);
        let camera = camera.map(CameraId::from);
        let (kind, message) = (kind.to_owned(), message.to_owned());
        self.take.events.push(NodeEvent { host_time_ns: HOST as u64, kind, camera, trigger, message });
    }

    fn fire(&mut self) {
        let mut at = FIRST;
        for place in 0..WARM_UP + self.before + TRIGGERS {
            let train = place - WARM_UP;
            if place > 0 {
                at += PERIOD + if PAUSE_BEFORE.contains(&train) { PERIOD / 2 } else { 0 };
            }
            let number = self.number(place as usize);
            let late = self.happens == Happens::Late && number > 0 && self.random.below(20) == 0;
            at += if late { PERIOD / 8 + self.random.below(2 * PERIOD) } else { self.random.below(3_000) };
            self.fired.push(at);
            let host = at + 60_000 + self.random.below(200_000);
            let held = if let Happens::ReportsHeldUp(ms) = self.happens {
                self.random.below(40) / 39 * ms * MS
            } else {
                0
            };
            let host = self.stands_until(host + held);
            if number >= 0 {
                let last = self.take.header.expected_triggers == Some(number as u64 + 1);
                let flags =
                    if late { TriggerFlags::LATE.0 } else { 0 } | if last { TriggerFlags::LAST.0 } else { 0 };
                let row = TriggerRecord {
                    index: TriggerIndex(number as u64),
                    hsu_time_ns: at as u64,
                    flags: flags.into(),
                    host_time_ns: (HOST + host) as u64,
                };
                let lost = self.happens == Happens::RowsLost && self.random.below(30) == 0;
                if !lost {
                    self.take.rows.push(row);
                }
            } else if train < 64 {
                let row = WarmUp::Trigger { number, hsu_time_ns: at as u64 };
                self.take.events.push(row.event(None, (HOST + host) as u64));
            }
        }
    }

    fn stands_until(&self, at: i64) -> i64 {
        let until = self.pauses.iter().filter(|(from, to)| (*from..*to).contains(&at)).map(|(_, to)| *to);
        until.max().unwrap_or(at)
    }

    fn pauses(&mut self, ms: i64) -> Vec<(i64, i64)> {
        let mut pauses = Vec::new();
        let mut at = FIRST + self.random.below(500 * MS);
        while at < FIRST + (self.before + TRIGGERS) * PERIOD {
            let to = at + self.random.below(ms * MS);
            pauses.push((at, to));
            at = to + self.random.below(1_500 * MS);
        }
        pauses
    }

    fn take(mut self) -> Take {
        if let Happens::Pauses(ms) = self.happens {
            self.pauses = self.pauses(ms);
        }
        self.fire();
        let end = *self.fired.last().expect("triggers");
        let mut at = FIRST - 1_500 * MS;
        while at < end + 300 * MS {
            self.sample(None, at, at);
            at += 200 * MS;
        }
        for place in 0..CAMERAS.len() {
            self.camera(place, end);
        }
        if self.before > 0 {
            self.event("record_pressed", None, 10, "Record was pressed here");
        }
        self.take
    }

    fn sample(&mut self, camera: Option<&str>, at: i64, device: i64) {
        let slow = self.random.below(12) == 0;
        let mut trip = || if slow { self.random.below(9 * MS) } else { 30_000 + self.random.below(150_000) };
        let (sent, received) = (at - trip(), at + trip());
        self.take.samples.push(ClockSample {
            camera: camera.map(CameraId::from),
            host_send_ns: (HOST + sent) as u64,
            host_receive_ns: (HOST + received) as u64,
            device_time_ns: device as u64,
        });
    }

    fn camera(&mut self, place: usize, end: i64) {
        let habits = CAMERAS[place];
        let own = if let Happens::PausesOfEach(ms) = self.happens { self.pauses(ms) } else { Vec::new() };
        let stands =
            |at: i64| own.iter().find(|(from, to)| (*from..*to).contains(&at)).map_or(at, |(_, to)| *to);
        if habits.stamps && !habits.clock {
            self.event("no_camera_clock", Some(habits.name), -1, "its clock cannot be read");
        }
        let ahead = (place as i64 + 1) * 1_005_000_000;
        // From which HSU time on its clock is so far ahead.
        let mut clocks = vec![(0, ahead)];
        let shows = |clocks: &[(i64, i64)], at: i64| {
            let ahead = clocks.iter().rev().find(|(from, _)| *from <= at).map_or(0, |(_, by)| *by);
            at + ahead + (at - FIRST) * habits.ppm / 1_000_000
        };
        let (mut id, mut latest) = (habits.id, 0);
        // Something happens at these triggers, far enough apart to be distinguished.
        let strikes: Vec<i64> = (0..4).map(|n| 20 + 55 * n + self.random.below(20)).collect();
        let (mut skip, mut back) = (0i64, false);
        for index in 0..self.fired.len() {
            let (number, fired) = (self.number(index), self.fired[index]);
            let strike = strikes.contains(&number);
            let gap = |take: &mut Take, cause| {
                if number >= 0 {
                    take.gaps[place].insert(number, cause);
                }
            };
            if skip > 0 {
                skip -= 1;
                let (cause, ids) = match self.happens {
                    Happens::Lost => (GapCause::MissingPackets, 1),
                    Happens::GivenUp => (GapCause::IdentityMismatch, 1),
                    Happens::Away => (GapCause::Unplugged, 0),
                    _ => (GapCause::NotTriggered, 0),
                };
                gap(&mut self.take, cause);
                id += ids;
                continue;
            }
            let (mut wrong, mut absent) = (0, false);
            match self.happens {
                Happens::Lost | Happens::Ignored | Happens::GivenUp | Happens::Away if strike => {
                    skip = if matches!(self.happens, Happens::Lost | Happens::Ignored) {
                        self.random.below(3)
                    } else {
                        12
                    };
                    match self.happens {
                        Happens::Lost => {
                            gap(&mut self.take, GapCause::MissingPackets);
                            id += 1;
                        }
                        Happens::Ignored => {
                            gap(&mut self.take, GapCause::NotTriggered);
                            self.event("trigger_ignored", Some(habits.name), number, "ignored");
                        }
                        Happens::GivenUp => {
                            gap(&mut self.take, GapCause::IdentityMismatch);
                            id += 3;
                        }
                        _ => {
                            gap(&mut self.take, GapCause::Unplugged);
                            self.event("camera_lost", Some(habits.name), number, "lost");
                            self.event("camera_back", Some(habits.name), -1, "back");
                            back = true;
                        }
                    }
                    continue;
                }
                Happens::Extra if strike => {
                    id += 1;
                    let first = strikes.first() == Some(&number);
                    let kind = if first { "spurious_frame" } else { "spurious_frames" };
                    self.event(kind, Some(habits.name), -1, "4 frames that no trigger explains");
                }
                Happens::IdJump if strike => {
                    id += 7;
                    self.event("id_jump", Some(habits.name), number, "ids jumped");
                }
                Happens::IdRepeated if strike => {
                    id -= 1;
                    self.event("id_repeated", Some(habits.name), number, "id came twice");
                }
                Happens::StampWrong(by) if strike && habits.stamps => {
                    wrong = by;
                    self.event("stamp_wrong", Some(habits.name), number, "the timestamp is off");
                }
                Happens::StampAbsent if strike && habits.stamps => {
                    absent = true;
                    self.event("stamp_wrong", Some(habits.name), number, "no timestamp");
                }
                Happens::ClockSet(by) if strikes[1] == number && habits.stamps => {
                    clocks.push((fired - MS, ahead + by));
                    self.event("camera_clock_reset", Some(habits.name), number, "set anew");
                }
                Happens::EverySecond if place == 0 && number.rem_euclid(2) == 1 => {
                    gap(&mut self.take, GapCause::NotTriggered);
                    continue;
                }
                Happens::WakesLate(count) if place == 0 && number < count - WARM_UP => {
                    gap(&mut self.take, GapCause::NotTriggered);
                    continue;
                }
                Happens::MissesFirst if number == 0 => {
                    gap(&mut self.take, GapCause::NotTriggered);
                    continue;
                }
                _ => {}
            }
            if std::mem::take(&mut back) {
                // A fresh stream; every second camera was switched off.
                id = 0;
                if strikes[0] % 2 == 0 {
                    clocks.push((fired - 20 * MS, self.random.below(MS) - fired + 70_000 * MS));
                }
                if habits.clock {
                    (0..16).for_each(|n| {
                        let at = fired - 19 * MS + n * MS;
                        self.sample(Some(habits.name), at, shows(&clocks, at));
                    });
                }
            }
            id += 1;
            let jitter = self.random.below(PERIOD / 100);
            let stamped = shows(&clocks, fired + PERIOD * habits.stamp / 100 + jitter) + wrong;
            let arrived = fired + PERIOD * habits.arrival / 100 + self.random.below(PERIOD / 20);
            let arrived = match self.happens {
                Happens::Batches(ms) => (arrived / (ms * MS) + 1) * ms * MS,
                _ => stands(self.stands_until(arrived)),
            };
            latest = arrived.max(latest + 20_000);
            let block = if habits.wide { 70_000 + id } else { (id - 1).rem_euclid(65_535) + 1 };
            let camera_ns = if habits.stamps && !absent { stamped } else { 0 };
            let seen =
                Seen { block: block as u64, camera_ns: camera_ns as u64, host_ns: (HOST + latest) as u64 };
            if number >= 0 {
                self.take.frames[place].insert(number, seen);
            } else if (index as i64) < WARM_UP {
                let Seen { block, camera_ns: camera_time_ns, host_ns: host_time_ns } = seen;
                let sample = WarmUp::Frame { block, camera_time_ns, host_time_ns };
                let camera = Some(CameraId::from(habits.name));
                self.take.events.push(sample.event(camera, host_time_ns));
            }
        }
        let mut at = FIRST - 1_000 * MS;
        while habits.clock && at < end {
            let burst = if at < FIRST { 16 } else { 1 };
            for n in 0..burst {
                self.sample(Some(habits.name), at + n * 400_000, shows(&clocks, at + n * 400_000));
            }
            at += 1_000 * MS;
        }
    }
}
