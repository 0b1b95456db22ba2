// SPDX-License-Identifier: MIT OR Apache-2.0
//! Histories that were seen, each with a name.

use super::history::{Arrives, HOST_MINUS_HSU_NS, History, Random, Traits};
use super::{Outcome, play, play_like, play_whole};
use crate::base::clock_fit::ClockFit;
use crate::base::ids::BlockId;
use crate::matcher::sighting::{Match, Sighting};
use crate::matcher::trigger_table::TriggerTable;
use crate::matcher::{Matcher, Start};
use hsu_firmware_proto::PAUSE_BEFORE;

const PERIOD_NS: u64 = 8_333_333;

/// A camera without faults, changed by `change`: of each frame its sighting and its trigger.
fn changed(seed: u64, traits: Traits, mut change: impl FnMut(&mut Sighting, i64)) -> Outcome {
    let mut history = History::of(seed, Traits { faults: false, ..traits });
    for (_, what) in &mut history.arrivals {
        if let Arrives::Frame(frame, Some(number)) = what {
            change(frame, *number);
        }
    }
    play(&history).0
}

fn habits(stamp_delay: u64, arrival_delay: u64) -> Traits {
    Traits {
        wide: false,
        stamps: true,
        clock: true,
        stamp_delay,
        arrival_delay,
        jitter: 5,
        batch_ns: 0,
        faults: false,
        busy: false,
        spells: false,
    }
}

fn all_right(outcome: Outcome) {
    assert_eq!((outcome.right, outcome.wrong, outcome.unconfirmed), (outcome.frames, 0, 0), "{outcome:?}");
}

/// A glitch, or a forged leader: that frame's id and arrival are right, and so are all others.
#[test]
fn one_wrong_stamp_moves_no_frame() {
    let wrong: [fn(u64) -> u64; 5] = [
        |ns| ns + 60_000_000,
        |ns| ns - 60_000_000,
        |ns| ns + 3 * PERIOD_NS,
        |_| u64::MAX,
        |ns| ns + (1 << 45),
    ];
    for (seed, wrong) in wrong.iter().enumerate() {
        for at in [1, 40] {
            all_right(changed(seed as u64, habits(10, 80), |frame, number| {
                if number == at {
                    frame.camera_ns = frame.camera_ns.map(wrong);
                }
            }));
        }
    }
}

#[test]
fn a_stamp_of_nothing_moves_no_frame() {
    all_right(changed(7, habits(10, 80), |frame, number| {
        if number == 30 {
            frame.camera_ns = None;
        }
    }));
}

/// 12 ms after the trigger at 120 Hz, and up to three periods; no clock that can be read, or no stamps at all.
#[test]
fn a_camera_without_a_clock_whose_frames_come_late_is_not_a_trigger_off() {
    for (seed, arrival_delay) in [(1, 144), (2, 220), (3, 295)] {
        let camera = Traits { clock: false, ..habits(20, arrival_delay) };
        all_right(changed(seed, camera, |_, _| {}));
        all_right(changed(seed, Traits { stamps: false, ..camera }, |_, _| {}));
    }
}

/// The end of exposure, of readout, the leader's sending: anything up to more than two periods after the trigger.
#[test]
fn a_camera_that_stamps_late_is_not_a_trigger_off() {
    for stamp_delay in [40, 60, 95, 150, 240] {
        all_right(changed(stamp_delay, habits(stamp_delay, 260), |_, _| {}));
    }
}

/// The link to the HSU stands still in the warm-up, for longer than frames can wait: they are given up, and once the
/// reports are there the rhythm is found, and every frame from there on is filed.
#[test]
fn reports_of_the_warm_up_may_come_late() {
    for seed in 0..50 {
        let traits = habits(10, 80);
        let mut history = History::of(seed, Traits { faults: false, ..traits });
        let begin = history.arrivals.iter().find(|(_, what)| matches!(what, Arrives::Report(..)));
        let late = begin.expect("a report").0 + (10 + 9 * seed % 60) * history.period_ns;
        for (at, what) in &mut history.arrivals {
            if let Arrives::Report(report) = what
                && report.number >= -7
            {
                *at = late.max(*at);
                report.heard_ns = *at;
            }
        }
        history.arrivals.sort_by_key(|(at, _)| *at);
        let before =
            |(at, what): &&(u64, Arrives)| *at <= late && matches!(what, Arrives::Frame(_, Some(0..)));
        let lost = history.arrivals.iter().filter(before).count() as u64;
        let (outcome, log) = play(&history);
        assert!(outcome.wrong == 0 && outcome.unconfirmed == 0, "{outcome:?}\n{}", log.join("\n"));
        assert!(outcome.given_up <= lost, "{seed}: {lost} came too early, {outcome:?}\n{}", log.join("\n"));
    }
}

/// A camera that sleeps through its first triggers: the rhythm of the warm-up tells.
#[test]
fn the_first_triggers_may_be_ignored() {
    for ignored in 1..=2 {
        let mut matcher = Matcher::new(Start {
            period_ns: PERIOD_NS,
            warm_up: 8,
            hsu_minus_host_ns: Some(-HOST_MINUS_HSU_NS),
        });
        let (mut table, hsu, mut fired) = (TriggerTable::default(), ClockFit::new(), 5_000_000_000);
        for number in -8..20i64 {
            fired += PERIOD_NS + if PAUSE_BEFORE.contains(&number) { PERIOD_NS / 2 } else { 0 };
            table.insert(number, fired);
            if number < -8 + ignored {
                continue;
            }
            let frame = Sighting {
                id: BlockId((number + 9 - ignored) as u64),
                camera_ns: Some(fired + 77_000_000_000),
                host_ns: (i128::from(fired + 5_000_000) + HOST_MINUS_HSU_NS) as u64,
                complete: true,
            };
            let answer = matcher.assign(&frame, &[], &table, &hsu, false);
            assert!(
                matches!(answer, Match::Trigger(matched) if number < 0 || matched.number == number),
                "{ignored} ignored, {number}: {answer:?}"
            );
        }
    }
}

/// A camera of the usual habits that takes only some triggers, its ids counting what it takes.
fn takes(seed: u64, takes: impl Fn(i64) -> bool) -> (Outcome, Vec<String>) {
    takes_on(History::of(seed, habits(10, 80)), seed, takes)
}

fn takes_on(mut history: History, seed: u64, takes: impl Fn(i64) -> bool) -> (Outcome, Vec<String>) {
    let others = (seed + 1000..).map(|seed| History::of(seed, habits(10, 80)));
    let alike = others.into_iter().find(|other| other.period_ns == history.period_ns);
    let (.., like) = play_whole(&alike.expect("one of this rate"), None);
    let mut id = 0;
    history.arrivals.retain_mut(|(_, what)| match what {
        Arrives::Frame(frame, Some(number)) if takes(*number) => {
            id += 1;
            frame.id = BlockId(id);
            true
        }
        Arrives::Frame(..) => false,
        _ => true,
    });
    assert!(like.is_some());
    play_like(&history, like)
}

/// Exposure and readout longer than a period, the commonest mistake of all: half of the frames come, and are kept.
#[test]
fn a_camera_that_takes_every_second_or_third_trigger_keeps_its_frames() {
    for seed in 0..40 {
        for (every, from) in [(2, 0), (2, 1), (3, 0), (3, 1), (3, 2)] {
            let (outcome, log) = takes(seed, |number| number.rem_euclid(every) == from);
            assert_eq!(outcome.wrong, 0, "{seed} {every} {from}\n{}", log.join("\n"));
            assert!(
                every == 3 || outcome.given_up <= 1,
                "{seed} {every} {from} {outcome:?}\n{}",
                log.join("\n")
            );
        }
    }
}

/// Half of the frames are taken up late, so that arrivals tell no trigger from the next.
fn on_a_busy_host(seed: u64) -> History {
    let mut history = History::of(seed, habits(10, 80));
    let mut random = Random::new(seed);
    let mut before = 0;
    for (at_ns, what) in &mut history.arrivals {
        if let Arrives::Frame(frame, Some(_)) = what {
            let tenths = match random.below(10) {
                0..=4 => 0,
                5..=8 => random.below(10),
                _ => random.below(25),
            };
            // In order, as they come from the socket.
            let late = (*at_ns + tenths * PERIOD_NS / 10).max(before) - *at_ns;
            (*at_ns, frame.host_ns) = (*at_ns + late, frame.host_ns + late);
            before = *at_ns;
        }
    }
    history.arrivals.sort_by_key(|(at_ns, _)| *at_ns);
    history
}

/// Where arrivals tell no trigger from the next, that a camera takes every second one is
/// known from the warm-up, or from the frames that show its place, and goes on.
#[test]
fn a_busy_host_costs_a_camera_that_takes_every_second_trigger_few_frames() {
    let mut all = Outcome::default();
    for seed in 0..40 {
        let (outcome, log) = takes_on(on_a_busy_host(seed), seed, |number| number.rem_euclid(2) == 0);
        assert_eq!(outcome.wrong, 0, "{seed}\n{}", log.join("\n"));
        all.add(outcome);
    }
    assert!(all.given_up * 50 <= all.frames, "more than a fiftieth given up: {all:?}");
}

/// What came and was given up was not ignored, though the camera had slept through some of the warm-up.
#[test]
fn a_camera_that_wakes_late_on_a_busy_host_ignored_no_trigger_of_the_session() {
    let mut given_up = 0;
    for seed in 0..200 {
        let (outcome, log) = takes_on(on_a_busy_host(seed), seed, |number| number >= -3);
        let ignored = log.iter().find(|line| line.contains("ignored: ") && !line.contains("ignored: 0"));
        let of_session = ignored.filter(|line| !line.contains("number: -"));
        assert!(of_session.is_none(), "{seed} {of_session:?}");
        given_up += outcome.given_up;
    }
    assert!(given_up > 0, "else this shows nothing");
}

/// Trigger 0 missed, after a warm-up that went well.
#[test]
fn a_missed_trigger_0_costs_that_frame_alone() {
    for seed in 0..40 {
        for missed in 0..4 {
            all_right(takes(seed, |number| number != missed).0);
        }
    }
}

/// A camera that wakes up late, even behind the warm-up: all is kept after the waking, since others of its make show
/// how long they take from a trigger.
#[test]
fn a_camera_that_wakes_late_keeps_what_comes_then() {
    for seed in 0..40 {
        for late in 0..12 {
            let (outcome, log) = takes(seed, |number| number >= late - 8);
            assert_eq!(outcome.wrong, 0, "{seed} {late}\n{}", log.join("\n"));
            assert!(outcome.given_up == 0, "{seed} {late} {outcome:?}\n{}", log.join("\n"));
        }
    }
}
