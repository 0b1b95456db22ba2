// SPDX-License-Identifier: MIT OR Apache-2.0
//! Held frame sets against a model: what is kept, in which order, under which numbers, and how much memory it takes.

use super::{Hold, PAST_EVENTS, Passed, trigger_of};
use crate::acquire::writer_queue::{ReadyFrame, ToWriter};
use crate::base::ids::{BlockId, TriggerIndex};
use crate::host::frame_memory::Block;
use crate::record::{ClockSample, FrameMeta, GapCause, NodeEvent, TriggerRecord, WarmUp};
use proptest::prelude::{ProptestConfig, prop_assert, prop_assert_eq, proptest};
use std::time::Instant;

const CAMERAS: usize = 3;

fn row(trigger: u64) -> ToWriter {
    let index = TriggerIndex(trigger);
    ToWriter::Trigger(TriggerRecord { index, hsu_time_ns: 1000 + trigger, flags: 0, host_time_ns: 0 })
}

fn frame(camera: usize, trigger: u64) -> ToWriter {
    let meta = FrameMeta {
        trigger: TriggerIndex(trigger),
        block: BlockId(trigger),
        camera_time_ns: 0,
        host_time_ns: 0,
        width: 4,
        height: 1,
        pixels_crc: 0,
    };
    let now = Instant::now();
    ToWriter::Frame(ReadyFrame { camera, meta, block: Block::allocate(4), taken: now, since: now })
}

fn event(kind: &str, trigger: Option<u64>) -> ToWriter {
    let (kind, trigger) = (kind.to_owned(), trigger.map(TriggerIndex));
    ToWriter::Event(NodeEvent { host_time_ns: 0, kind, camera: None, trigger, message: String::new() })
}

fn warm_up(number: i64) -> ToWriter {
    ToWriter::Event(WarmUp::Trigger { number, hsu_time_ns: number.unsigned_abs() }.event(None, 0))
}

/// `FRAME camera trigger block`, and so on: the record as one line.
fn line(item: &ToWriter) -> String {
    match item {
        ToWriter::Frame(frame) => {
            format!("frame {} {} {}", frame.camera, frame.meta.trigger, frame.meta.block)
        }
        ToWriter::Gap(camera, trigger, cause) => format!("gap {camera} {trigger} {cause}"),
        ToWriter::Trigger(record) => format!("row {} {}", record.index, record.hsu_time_ns),
        ToWriter::Event(event) => match WarmUp::of(event) {
            Some(WarmUp::Trigger { number, .. }) => format!("warm_up {number}"),
            _ => format!("{} {:?}", event.kind, event.trigger.map(|trigger| trigger.0)),
        },
        ToWriter::Clock(_) => "clock".to_owned(),
        ToWriter::End(_) => "end".to_owned(),
    }
}

/// The items of a trigger: its row, and for each camera a frame or, where `lost` has its bit, a gap.
fn of_trigger(trigger: u64, lost: u8) -> Vec<ToWriter> {
    let outcome = |camera: usize| match lost >> camera & 1 {
        0 => frame(camera, trigger),
        _ => ToWriter::Gap(camera, TriggerIndex(trigger), GapCause::MissingPackets),
    };
    std::iter::once(row(trigger)).chain((0..CAMERAS).map(outcome)).collect()
}

fn frames_in(hold: &Hold) -> usize {
    hold.items.iter().filter(|item| matches!(item, ToWriter::Frame(_))).count()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]
    /// What is recorded is what an ordinary session would have recorded from the named trigger on, counted from it,
    /// as far as it is held; and memory stays within its bound.
    #[test]
    fn the_recording_begins_where_record_says(
        most in 1_u64..12,
        before in 0_u64..40,
        behind in 0_u64..20,
        back in 0_u64..50,
        lost in proptest::collection::vec(0_u8..8, 60),
        paced in proptest::collection::vec(0_usize..6, 60),
    ) {
        let mut hold = Hold::new(most);
        let (mut in_memory, mut passed) = (0, Vec::new());
        let take = |hold: &mut Hold, item: ToWriter, in_memory: &mut usize, passed: &mut Vec<String>| {
            *in_memory += usize::from(matches!(item, ToWriter::Frame(_)));
            match hold.take(item) {
                Passed::On(item) => {
                    *in_memory -= usize::from(matches!(item, ToWriter::Frame(_)));
                    passed.push(line(&item));
                }
                Passed::Held(gone) => *in_memory -= gone,
            }
        };
        for trigger in 0..before {
            for item in of_trigger(trigger, lost[trigger as usize]) {
                take(&mut hold, item, &mut in_memory, &mut passed);
            }
            prop_assert_eq!(in_memory, frames_in(&hold));
            prop_assert!(in_memory <= most as usize * CAMERAS);
        }
        prop_assert!(passed.is_empty(), "nothing is recorded before Record: {passed:?}");
        prop_assert!(hold.next().is_none());

        let first = before.saturating_sub(back);
        let (older, missing) = hold.keep(first);
        in_memory -= older;
        prop_assert_eq!(in_memory, frames_in(&hold));
        prop_assert_eq!(missing.clone().count() as u64, before.saturating_sub(most).saturating_sub(first));
        for trigger in before..before + behind {
            for item in of_trigger(trigger, lost[trigger as usize]) {
                take(&mut hold, item, &mut in_memory, &mut passed);
            }
            // The writer follows as it can.
            for _ in 0..paced[trigger as usize] {
                passed.extend(hold.next().as_ref().map(line));
            }
        }
        passed.extend(std::iter::from_fn(|| hold.next()).map(|item| line(&item)));
        let held_from = first.max(before.saturating_sub(most));
        let expected = (held_from..before + behind).flat_map(|trigger| of_trigger(trigger, lost[trigger as usize]));
        let expected: Vec<String> =
            expected.filter_map(|item| super::counted_from(first, item)).map(|item| line(&item)).collect();
        passed.retain(|line| !line.starts_with("warm_up"));
        prop_assert_eq!(passed, expected);
    }
}

/// A stream's beginning is found in the recording as in any other: its warm-up has numbers before those of the
/// recording.
#[test]
fn the_warm_up_keeps_its_distance_to_the_recording() {
    let mut hold = Hold::new(5);
    for number in -4..0 {
        assert!(matches!(hold.take(warm_up(number)), Passed::Held(0)));
    }
    for trigger in 0..100 {
        of_trigger(trigger, 0).into_iter().for_each(|item| drop(hold.take(item)));
    }
    hold.keep(97);
    let rows: Vec<String> = std::iter::from_fn(|| hold.next()).map(|item| line(&item)).collect();
    let expected: Vec<String> =
        (-4..0).chain(0..64).map(|number: i64| format!("warm_up {}", number - 97)).collect();
    assert_eq!(rows[..68], expected);
    assert_eq!(rows[68], "row 0 1097");
}

#[test]
fn what_is_of_no_trigger_is_recorded_at_once_and_earlier_events_stay() {
    let mut hold = Hold::new(2);
    let sample = ClockSample { camera: None, host_send_ns: 1, host_receive_ns: 2, device_time_ns: 3 };
    assert!(matches!(hold.take(ToWriter::Clock(sample)), Passed::On(_)));
    assert!(matches!(hold.take(event("camera_back", None)), Passed::On(_)));
    for trigger in 0..1000 {
        drop(hold.take(event("frames_lost", Some(trigger))));
        of_trigger(trigger, 0).into_iter().for_each(|item| drop(hold.take(item)));
    }
    assert!(hold.past.len() <= PAST_EVENTS, "bounded");
    hold.keep(999);
    let rows: Vec<String> = std::iter::from_fn(|| hold.next()).map(|item| line(&item)).collect();
    let events: Vec<&String> = rows.iter().filter(|row| row.starts_with("frames_lost")).collect();
    assert_eq!(events.len(), PAST_EVENTS + 2, "the last ones of before, and those that are held");
    assert_eq!(
        (events[0].as_str(), events[PAST_EVENTS + 1].as_str()),
        ("frames_lost None", "frames_lost Some(0)")
    );
}

/// A frame of a set that was passed on without it comes behind others.
#[test]
fn a_late_frame_gives_way_in_its_turn() {
    let mut hold = Hold::new(3);
    let mut gone = 0;
    let mut take = |item: ToWriter| {
        if let Passed::Held(frames) = hold.take(item) {
            gone += frames;
        }
    };
    for trigger in 0..50 {
        take(frame(0, trigger));
        // Camera 1 is always two triggers late.
        if trigger >= 2 {
            take(frame(1, trigger - 2));
        }
    }
    let held = frames_in(&hold);
    assert_eq!(held + gone, 98);
    assert!(held <= 8, "{held} frames for three triggers");
    assert!(hold.items.iter().all(|item| trigger_of(item).is_some()));
}

#[test]
fn a_second_record_changes_nothing() {
    let mut hold = Hold::new(3);
    (0..5).for_each(|trigger| of_trigger(trigger, 0).into_iter().for_each(|item| drop(hold.take(item))));
    assert_eq!(hold.keep(3), (CAMERAS, 3..3));
    let held = frames_in(&hold);
    assert_eq!(hold.keep(0), (0, 0..0));
    assert_eq!((held, frames_in(&hold), hold.first()), (2 * CAMERAS, 2 * CAMERAS, Some(3)));
}
