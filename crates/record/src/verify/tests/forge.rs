// SPDX-License-Identifier: MIT OR Apache-2.0
//! Forgeries: by source, by how much, and for how long.

use super::take::{CAMERAS, Frames, Happens, PERIOD, Take};
use crate::base::ids::TriggerIndex;
use crate::layout::{GapCause, TriggerRecord, WarmUp};
use crate::verify::Severity;
use crate::verify::frame::Seen;
use hsu_firmware_proto::TriggerFlags;
use std::ops::Range;

const HALF_AN_HOUR: i64 = 1_800_000_000_000;

/// What is done to a recording.
pub type Forge = Box<dyn Fn(&mut Take)>;

/// One way to forge a recording.
pub struct Forgery {
    pub what: String,
    /// What happens in the honest recording.
    pub of: Happens,
    pub forge: Forge,
    /// How bad it is at least.
    pub expected: Severity,
    /// What a finding of that severity must name.
    pub camera: Option<&'static str>,
    pub triggers: Option<(u64, u64)>,
}

fn moved(ns: u64, by: i64) -> u64 {
    ns.saturating_add_signed(by)
}

/// Triggers that are forged: one, some, and all from there on.
fn durations() -> [(&'static str, Range<i64>); 3] {
    [("one", 100..101), ("twenty", 100..120), ("for good", 100..i64::MAX)]
}

fn frames(take: &mut Take, camera: usize, triggers: &Range<i64>, change: impl Fn(&mut Seen)) {
    take.frames[camera]
        .iter_mut()
        .filter(|(number, _)| triggers.contains(*number))
        .for_each(|(_, seen)| change(seen));
}

/// Frames of a camera stand under other triggers; what is left without one becomes a gap.
fn relabel(frames: &mut Frames, triggers: &Range<i64>, by: i64) {
    let own: Vec<(i64, Seen)> =
        frames.iter().filter(|(n, _)| triggers.contains(*n)).map(|(n, s)| (*n, *s)).collect();
    own.iter().for_each(|(number, _)| {
        frames.remove(number);
    });
    let end =
        frames.keys().next_back().copied().unwrap_or(0).max(own.last().map_or(0, |(number, _)| *number));
    for (number, seen) in own {
        if (0..=end).contains(&(number + by)) {
            frames.insert(number + by, seen);
        }
    }
}

/// Moves all triggers and frames of a recording by a number of triggers.
pub fn relabel_all(take: &mut Take, by: i64) {
    take.frames.iter_mut().for_each(|frames| relabel(frames, &(0..i64::MAX), by));
    let mut rows = take.rows.clone();
    for row in &mut rows {
        row.index = TriggerIndex(row.index.0.saturating_add_signed(by));
    }
    rows.retain(|row| row.index.0 < take.rows.len() as u64);
    take.rows = rows;
}

pub fn each_warm_up_trigger(take: &mut Take, change: impl Fn(u64) -> u64) {
    for event in &mut take.events {
        if let Some(WarmUp::Trigger { number, hsu_time_ns }) = WarmUp::of(event) {
            *event =
                WarmUp::Trigger { number, hsu_time_ns: change(hsu_time_ns) }.event(None, event.host_time_ns);
        }
    }
}

fn each_warm_up_frame(take: &mut Take, camera: usize, change: impl Fn(&mut Seen)) {
    let id = Some(CAMERAS[camera].name);
    for event in take.events.iter_mut().filter(|event| event.camera.as_ref().map(|id| id.as_str()) == id) {
        if let Some(WarmUp::Frame { block, camera_time_ns, host_time_ns }) = WarmUp::of(event) {
            let mut seen = Seen { block, camera_ns: camera_time_ns, host_ns: host_time_ns };
            change(&mut seen);
            let Seen { block, camera_ns: camera_time_ns, host_ns: host_time_ns } = seen;
            *event = WarmUp::Frame { block, camera_time_ns, host_time_ns }
                .event(event.camera.clone(), event.host_time_ns);
        }
    }
}

fn rows(take: &mut Take, triggers: &Range<i64>, change: impl Fn(&mut TriggerRecord)) {
    take.rows.iter_mut().filter(|row| triggers.contains(&(row.index.0 as i64))).for_each(change);
}

fn readings(take: &mut Take, camera: Option<&str>, from: usize, count: usize, by: i64) {
    let own = take.samples.iter_mut().filter(|sample| sample.camera.as_ref().map(|id| id.as_str()) == camera);
    own.skip(from).take(count).for_each(|sample| sample.device_time_ns = moved(sample.device_time_ns, by));
}

/// Everything of a session half an hour later.
pub fn half_an_hour(take: &mut Take) {
    for camera in 0..CAMERAS.len() {
        frames(take, camera, &(0..i64::MAX), |seen| {
            seen.host_ns = moved(seen.host_ns, HALF_AN_HOUR);
            seen.camera_ns = if seen.camera_ns == 0 { 0 } else { moved(seen.camera_ns, HALF_AN_HOUR) };
        });
    }
    rows(take, &(0..i64::MAX), |row| {
        (row.hsu_time_ns, row.host_time_ns) =
            (moved(row.hsu_time_ns, HALF_AN_HOUR), moved(row.host_time_ns, HALF_AN_HOUR));
    });
}

fn of_frames(all: &mut Vec<Forgery>) {
    let mut add = |what: String, camera: usize, triggers: &Range<i64>, forge: Forge| {
        let to = triggers.end.min(239) as u64;
        all.push(Forgery {
            what: format!("{what}, {}", CAMERAS[camera].name),
            of: Happens::Nothing,
            forge,
            expected: Severity::Corrupt,
            camera: Some(CAMERAS[camera].name),
            triggers: Some((triggers.start as u64, to)),
        });
    };
    for (duration, triggers) in durations() {
        for camera in [0, 1, 3] {
            for periods in [-2, -1, 1, 2, 90_000] {
                let own = triggers.clone();
                let by = periods * PERIOD;
                let forge = move |take: &mut Take| {
                    frames(take, camera, &own, |seen| seen.camera_ns = moved(seen.camera_ns, by))
                };
                add(format!("stamps {periods} periods off, {duration}"), camera, &triggers, Box::new(forge));
            }
        }
        for camera in 0..CAMERAS.len() {
            for by in [-1, 1, 2] {
                let own = triggers.clone();
                let forge = move |take: &mut Take| {
                    frames(take, camera, &own, |seen| seen.block = moved(seen.block, by))
                };
                add(format!("ids {by} off, {duration}"), camera, &triggers, Box::new(forge));
            }
            for by in [-1, 1] {
                let own = triggers.clone();
                let forge = move |take: &mut Take| relabel(&mut take.frames[camera], &own, by);
                let near = (triggers.start - 1)..triggers.end.saturating_add(1);
                if duration != "one" {
                    add(
                        format!("frames under triggers {by} off, {duration}"),
                        camera,
                        &near,
                        Box::new(forge),
                    );
                }
            }
            let own = triggers.clone();
            let forge = move |take: &mut Take| {
                frames(take, camera, &own, |seen| seen.host_ns = moved(seen.host_ns, -3_000_000_000))
            };
            add(format!("arrivals 3 s early, {duration}"), camera, &triggers, Box::new(forge));
            // Ids and stamps agree with it, and the labels are those of the next trigger: it came before that was
            // fired, or earlier than any.
            let own = triggers.clone();
            let forge = move |take: &mut Take| {
                frames(take, camera, &own, |seen| {
                    seen.host_ns = moved(seen.host_ns, -2 * PERIOD);
                });
            };
            add(format!("arrivals two periods early, {duration}"), camera, &triggers, Box::new(forge));
        }
        let own = triggers.clone();
        let frozen = move |take: &mut Take| {
            let first = take.frames[0][&own.start].camera_ns;
            frames(take, 0, &own, |seen| seen.camera_ns = first);
        };
        if duration != "one" {
            add(
                format!("stamps frozen, {duration}"),
                0,
                &(triggers.start + 1..triggers.end),
                Box::new(frozen),
            );
            let own = triggers.clone();
            let behind = move |take: &mut Take| {
                let before = take.frames[0].clone();
                let stamp = |number: i64| before[&(number - 1)].camera_ns;
                take.frames[0]
                    .iter_mut()
                    .filter(|(n, _)| own.contains(*n))
                    .for_each(|(n, s)| s.camera_ns = stamp(*n));
            };
            add(format!("stamps of the frame before, {duration}"), 0, &triggers, Box::new(behind));
            let own = triggers.clone();
            let random = move |take: &mut Take| {
                let mixed =
                    |seen: &mut Seen| seen.block = (seen.block.wrapping_mul(0x9e37_79b9) >> 7) & 0xffff;
                frames(take, 2, &own, mixed);
            };
            add(format!("ids at random, {duration}"), 2, &triggers, Box::new(random));
            let own = triggers.clone();
            let swapped = move |take: &mut Take| {
                let (mut up, mut low) = (take.frames[0].clone(), take.frames[3].clone());
                for number in own.start..own.end.min(240) {
                    let (a, b) = (take.frames[0][&number], take.frames[3][&number]);
                    up.insert(number, b);
                    low.insert(number, a);
                }
                (take.frames[0], take.frames[3]) = (up, low);
            };
            add(format!("two cameras exchanged, {duration}"), 0, &triggers, Box::new(swapped));
        }
    }
    // Ids do not name their camera: frames, warm-up and all, under each other's names; the clocks' readings
    // stay.
    let swapped = |take: &mut Take| {
        take.frames.swap(0, 3);
        for event in take.events.iter_mut().filter(|event| WarmUp::of(event).is_some()) {
            let name = event.camera.as_ref().map(|id| id.as_str().to_owned());
            event.camera = match name.as_deref() {
                Some("h0_up") => Some("h1_low".into()),
                Some("h1_low") => Some("h0_up".into()),
                _ => event.camera.take(),
            };
        }
    };
    add("two cameras exchanged with their warm-up".to_owned(), 0, &(0..i64::MAX), Box::new(swapped));
}

fn of_the_rest(all: &mut Vec<Forgery>) {
    let mut add = |what: String, triggers: Option<(u64, u64)>, camera, expected, forge: Forge| {
        all.push(Forgery { what, of: Happens::Nothing, forge, expected, camera, triggers });
    };
    let corrupt = Severity::Corrupt;
    for (duration, triggers) in durations() {
        let near = Some((triggers.start as u64, triggers.end.min(239) as u64 + 1));
        for periods in [-2, -1, 1, 2] {
            let own = triggers.clone();
            let forge = move |take: &mut Take| {
                rows(take, &own, |row| row.hsu_time_ns = moved(row.hsu_time_ns, periods * PERIOD))
            };
            add(
                format!("trigger times {periods} periods off, {duration}"),
                near,
                None,
                corrupt,
                Box::new(forge),
            );
            let own = triggers.clone();
            // With the flag that excuses a late one, and the reports behind them.
            let forge = move |take: &mut Take| {
                rows(take, &own, |row| {
                    row.hsu_time_ns = moved(row.hsu_time_ns, periods * PERIOD);
                    row.host_time_ns = moved(row.host_time_ns, periods.max(0) * PERIOD);
                    row.flags |= u32::from(TriggerFlags::LATE.0);
                });
            };
            add(
                format!("late trigger times {periods} periods off, {duration}"),
                near,
                None,
                corrupt,
                Box::new(forge),
            );
        }
        let own = triggers.clone();
        let forge = move |take: &mut Take| {
            rows(take, &own, |row| row.host_time_ns = moved(row.host_time_ns, -PERIOD))
        };
        add(format!("reports a period early, {duration}"), near, None, corrupt, Box::new(forge));
        for periods in [-1, 1] {
            let count = match duration {
                "one" => 1,
                "twenty" => 3,
                _ => usize::MAX,
            };
            let expected = if duration == "one" { Severity::Unconfirmed } else { corrupt };
            let forge = move |take: &mut Take| readings(take, Some("h0_up"), 17, count, periods * PERIOD);
            add(
                format!("readings of a camera {periods} periods off, {duration}"),
                None,
                Some("h0_up"),
                expected,
                Box::new(forge),
            );
            let forge = move |take: &mut Take| readings(take, None, 12, count, periods * PERIOD);
            add(
                format!("readings of the HSU {periods} periods off, {duration}"),
                None,
                None,
                expected,
                Box::new(forge),
            );
        }
    }
    for periods in [-1, 1] {
        let whole = move |take: &mut Take| {
            rows(take, &(0..i64::MAX), |row| row.hsu_time_ns = moved(row.hsu_time_ns, periods * PERIOD));
            each_warm_up_trigger(take, |ns| moved(ns, periods * PERIOD));
        };
        add(
            format!("the HSU's times {periods} periods off from the start"),
            Some((0, 239)),
            None,
            corrupt,
            Box::new(whole),
        );
        let forge = move |take: &mut Take| readings(take, None, 0, usize::MAX, periods * PERIOD);
        add(format!("all readings of the HSU {periods} periods off"), None, None, corrupt, Box::new(forge));
        for camera in [0, 1, 3] {
            let forge = move |take: &mut Take| {
                each_warm_up_frame(take, camera, |seen| {
                    seen.camera_ns = moved(seen.camera_ns, periods * PERIOD)
                })
            };
            add(
                format!("stamps of the warm-up {periods} periods off"),
                Some((0, 239)),
                Some(CAMERAS[camera].name),
                corrupt,
                Box::new(forge),
            );
        }
        for (camera, habits) in CAMERAS.iter().enumerate() {
            let forge = move |take: &mut Take| {
                each_warm_up_frame(take, camera, |seen| seen.block = moved(seen.block, periods + 3))
            };
            add(
                format!("ids of the warm-up {} off", periods + 3),
                Some((0, 239)),
                Some(habits.name),
                corrupt,
                Box::new(forge),
            );
        }
        let forge = move |take: &mut Take| each_warm_up_trigger(take, |ns| moved(ns, periods * PERIOD));
        add(format!("times of the warm-up {periods} periods off"), None, None, corrupt, Box::new(forge));
        // Of all cameras: frames of one trigger under another.
        let all = move |take: &mut Take| {
            take.frames.iter_mut().for_each(|frames| relabel(frames, &(60..i64::MAX), periods));
        };
        add(
            format!("all cameras {periods} triggers off from 60 on"),
            Some((60, 239)),
            Some("h0_up"),
            corrupt,
            Box::new(all),
        );
        // A gap record that explains the count: the stamps are forged to fit, and arrivals are what they are.
        let ignored = move |take: &mut Take| {
            let count = periods.max(0);
            relabel(&mut take.frames[3], &(100..i64::MAX), periods);
            take.gaps[3].insert(100, GapCause::NotTriggered);
            frames(take, 3, &(100 + count..i64::MAX), |seen| {
                seen.camera_ns = moved(seen.camera_ns, periods * PERIOD)
            });
        };
        add(
            format!("an ignored trigger that was none, {periods}"),
            Some((98, 239)),
            Some("h1_low"),
            corrupt,
            Box::new(ignored),
        );
    }
    // For good, all of them later: nothing contradicts that, but nothing confirms it.
    let forge =
        |take: &mut Take| frames(take, 0, &(60..i64::MAX), |seen| seen.host_ns = moved(seen.host_ns, PERIOD));
    add(
        "arrivals a period late for good".to_owned(),
        Some((60, 239)),
        Some("h0_up"),
        Severity::Unconfirmed,
        Box::new(forge),
    );
    let eight = |take: &mut Take| {
        for camera in 0..CAMERAS.len() {
            frames(take, camera, &(100..102), |seen| {
                seen.host_ns = moved(seen.host_ns, HALF_AN_HOUR);
                seen.camera_ns = moved(seen.camera_ns, HALF_AN_HOUR);
            });
        }
    };
    add(
        "eight frames of a session half an hour later".to_owned(),
        Some((100, 103)),
        Some("h0_up"),
        corrupt,
        Box::new(eight),
    );
    let close = |take: &mut Take| take.rows[100].hsu_time_ns = take.rows[99].hsu_time_ns + 1_000_000;
    add("two triggers 1 ms apart".to_owned(), Some((100, 101)), None, corrupt, Box::new(close));
    add(
        "a rate of 60 Hz".to_owned(),
        None,
        None,
        corrupt,
        Box::new(|take| take.header.trigger_rate_hz = 60.0),
    );
    add(
        "twice the rate".to_owned(),
        None,
        None,
        corrupt,
        Box::new(|take| take.header.trigger_rate_hz = 100.0),
    );
    let created = |take: &mut Take| take.header.created_ns = moved(take.header.created_ns, HALF_AN_HOUR);
    add("created half an hour later".to_owned(), None, None, corrupt, Box::new(created));
    let created = |take: &mut Take| take.header.created_ns = moved(take.header.created_ns, -HALF_AN_HOUR);
    add("created half an hour earlier".to_owned(), None, None, corrupt, Box::new(created));
    for (camera, habits) in CAMERAS.iter().enumerate() {
        let arrived = move |take: &mut Take| {
            frames(take, camera, &(60..i64::MAX), |seen| seen.host_ns = moved(seen.host_ns, HALF_AN_HOUR));
        };
        let name = Some(habits.name);
        let what = "arrivals half an hour late for good".to_owned();
        add(what, Some((60, 239)), name, corrupt, Box::new(arrived));
    }
    // Counter and clock together: the arrivals do not confirm it.
    for periods in [-1, 1] {
        let both = move |take: &mut Take| {
            relabel(&mut take.frames[3], &(120..i64::MAX), periods);
            frames(take, 3, &(120 + periods.max(0)..i64::MAX), |seen| {
                seen.block = moved(seen.block, periods);
                seen.camera_ns = moved(seen.camera_ns, periods * PERIOD);
            });
            take.frames[3].retain(|number, _| *number < 239);
        };
        let what = format!("counter and clock of frames {periods} triggers off together");
        add(what, Some((118, 239)), Some("h1_low"), Severity::Unconfirmed, Box::new(both));
    }
    let unread = |take: &mut Take| {
        take.samples.retain(|sample| sample.camera.as_ref().is_none_or(|id| id.as_str() != "h0_up"));
    };
    let unconfirmed = Severity::Unconfirmed;
    add("readings of a camera left out".to_owned(), None, Some("h0_up"), unconfirmed, Box::new(unread));
    let last = |take: &mut Take| {
        take.rows.truncate(200);
        take.rows[199].flags |= u32::from(TriggerFlags::LAST.0);
        take.frames.iter_mut().for_each(|frames| frames.retain(|number, _| *number < 200));
    };
    add("the last trigger called so too early".to_owned(), Some((199, 199)), None, corrupt, Box::new(last));
    let longer = |take: &mut Take| take.header.expected_triggers = Some(300);
    add("more triggers asked for".to_owned(), Some((239, 239)), None, corrupt, Box::new(longer));
    let session = |take: &mut Take| {
        half_an_hour(take);
        rows(take, &(0..i64::MAX), |_| ());
    };
    add("all but the warm-up half an hour later".to_owned(), None, None, corrupt, Box::new(session));
    // An id that is skipped, with the event of a frame that nothing triggered: stamps are one behind, arrivals late by
    // as much.
    let behind = |take: &mut Take| {
        let before = take.frames[0].clone();
        for (number, seen) in take.frames[0].range_mut(100..) {
            *seen = before.get(&(number + 1)).copied().unwrap_or(*seen);
            seen.camera_ns = before[number].camera_ns;
        }
        take.frames[0].remove(&239);
        take.events.push(crate::NodeEvent {
            host_time_ns: 0,
            kind: "spurious_frame".to_owned(),
            camera: Some("h0_up".into()),
            trigger: None,
            message: "block 70109 lies a period from the nearest trigger; not recorded".to_owned(),
        });
    };
    add(
        "stamps one trigger behind, as the program filed them".to_owned(),
        Some((100, 239)),
        Some("h0_up"),
        corrupt,
        Box::new(behind),
    );
}

/// What honestly happened excuses nothing that is forged beside it.
fn of_eventful_sessions(all: &mut Vec<Forgery>) {
    use Happens::*;
    let kinds = [
        Lost,
        Ignored,
        Extra,
        IdJump,
        GivenUp,
        Away,
        Late,
        RowsLost,
        MissesFirst,
        Endless,
        StampWrong(PERIOD),
        StampAbsent,
        ClockSet(PERIOD),
        ClockSet(7_000_000_000),
        Pauses(300),
        Batches(9),
        BeforeRecord(40),
        BeforeRecord(2_000),
    ];
    for of in kinds {
        let mut add = |what: &str, forge: Forge| {
            all.push(Forgery {
                what: format!("{what}, {of:?}"),
                of,
                forge,
                expected: Severity::Corrupt,
                camera: Some("h0_up"),
                triggers: Some((90, 239)),
            });
        };
        // One that nothing happened to.
        let plain = |take: &Take| (95..).find(|n| (n - 2..n + 3).all(|n| take.frames[0].contains_key(&n)));
        let one = move |take: &Take| plain(take).map_or(0..0, |number| number..number + 1);
        add(
            "a stamp a period off",
            Box::new(move |take| {
                let own = one(take);
                frames(take, 0, &own, |seen| seen.camera_ns = moved(seen.camera_ns, PERIOD));
            }),
        );
        add(
            "an id one off",
            Box::new(move |take| {
                let own = one(take);
                frames(take, 0, &own, |seen| seen.block += 1);
            }),
        );
        add(
            "ids two off for good",
            Box::new(move |take| {
                let own = one(take).start..i64::MAX;
                frames(take, 0, &own, |seen| seen.block += 2);
            }),
        );
        add(
            "frames a trigger late for good",
            Box::new(move |take| {
                let own = one(take).start..i64::MAX;
                relabel(&mut take.frames[0], &own, 1);
            }),
        );
        add(
            "a frame of another session",
            Box::new(move |take| {
                let own = one(take);
                frames(take, 0, &own, |seen| {
                    (seen.camera_ns, seen.host_ns) =
                        (moved(seen.camera_ns, HALF_AN_HOUR), moved(seen.host_ns, HALF_AN_HOUR));
                });
            }),
        );
    }
}

/// All forgeries that verification has to find.
pub fn all() -> Vec<Forgery> {
    let mut all = Vec::new();
    of_eventful_sessions(&mut all);
    of_frames(&mut all);
    of_the_rest(&mut all);
    all
}
