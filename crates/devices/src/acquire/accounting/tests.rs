// SPDX-License-Identifier: MIT OR Apache-2.0
//! The accounting by itself, turn by turn: whose frames count, and what stands in for reports that are held up.

use super::*;
use crate::acquire::preview::Taps;
use crate::acquire::writer_queue::Sink;
use crate::base::ids::BlockId;
use crate::host::frame_memory::Block;
use crate::matcher::Start;
use crate::record::{RecordError, TriggerRecord, Verdict};
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Mutex;

const PERIOD_NS: u64 = 8_333_333;
const HOST_NS: u64 = 50_000_000_000;

/// By trigger and camera: the block that was recorded, or why there is none.
type Outcomes = BTreeMap<(u64, usize), Result<u64, GapCause>>;

/// A sink that keeps all outcomes.
struct Kept(Arc<Mutex<Outcomes>>);

impl Sink for Kept {
    fn write(&mut self, item: ToWriter) -> Result<(), RecordError> {
        let (key, outcome) = match item {
            ToWriter::Frame(frame) => ((frame.meta.trigger.0, frame.camera), Ok(frame.meta.block.0)),
            ToWriter::Gap(camera, trigger, cause) => ((trigger.0, camera), Err(cause)),
            _ => return Ok(()),
        };
        let before = self.0.lock().expect("not poisoned").insert(key, outcome);
        assert_eq!(before, None, "a second outcome for {key:?}");
        Ok(())
    }

    fn finish(self: Box<Self>, _: SessionEnd) -> Result<Verdict, RecordError> {
        Err(RecordError::Stopped { reason: "a stand-in has no verdict".to_owned() })
    }
}

struct Desk {
    accounting: Accounting,
    outcomes: Arc<Mutex<Outcomes>>,
    closed: crossbeam_channel::Receiver<RecorderEvent>,
}

impl Desk {
    /// The cameras' clocks are the HSU's, which is [`HOST_NS`] behind the host's.
    fn new(cameras: usize) -> Self {
        Self::warming_up(cameras, 0)
    }

    /// With this number of triggers before trigger 0.
    fn warming_up(cameras: usize, warm_up: u32) -> Self {
        let outcomes = Arc::default();
        let progress = Arc::new(Progress::new(cameras));
        let (events, closed) = crossbeam_channel::unbounded();
        let options = RecorderOptions::new(PERIOD_NS, 512, WhenFull::DropFrameSet);
        let sink = Box::new(Kept(Arc::clone(&outcomes)));
        let ring =
            Ring::start(sink, (4096, 0), None, Taps::of_nobody(), Arc::clone(&progress), events.clone())
                .expect("a thread");
        let start = Start { period_ns: PERIOD_NS, warm_up, hsu_minus_host_ns: Some(-i128::from(HOST_NS)) };
        let lane = |camera| LaneSetup {
            id: CameraId(format!("c{camera}")),
            width: 16,
            height: 1,
            matcher: Matcher::new(start),
        };
        let lanes = (0..cameras).map(lane).collect();
        Self { accounting: Accounting::new(lanes, options, progress, ring, events), outcomes, closed }
    }

    fn report(&mut self, trigger: u64, hsu_time_ns: u64) {
        self.report_flagged(trigger, hsu_time_ns, 0);
    }

    fn report_flagged(&mut self, trigger: u64, hsu_time_ns: u64, flags: u32) {
        let (index, host_time_ns) = (TriggerIndex(trigger), HOST_NS + hsu_time_ns + 500_000);
        let record = TriggerRecord { index, hsu_time_ns, flags, host_time_ns };
        self.accounting.handle(RecorderCommand::Trigger(record));
    }

    /// Reports a trigger when it is fired, and those of `held` behind the last of them.
    fn report_held(&mut self, trigger: u64, held: &Range<u64>) {
        if trigger == held.end {
            held.clone().for_each(|late| self.report(late, due(late)));
        }
        if !held.contains(&trigger) {
            self.report(trigger, due(trigger));
        }
    }

    /// Reports a trigger of the warm-up or of the session.
    fn report_numbered(&mut self, number: i64, hsu_time_ns: u64) {
        match u64::try_from(number) {
            Ok(trigger) => self.report(trigger, hsu_time_ns),
            Err(_) => self.accounting.handle(RecorderCommand::WarmUp {
                number,
                hsu_time_ns,
                late: false,
                host_time_ns: hsu_time_ns + HOST_NS,
            }),
        }
    }

    fn frame(&mut self, camera: usize, stream: u32, block: u64, exposed_ns: u64) {
        self.frame_stamped((camera, stream), block, exposed_ns, exposed_ns + 3_000_000);
    }

    /// With this timestamp, and arriving then, both by the HSU's clock.
    fn frame_stamped(&mut self, (camera, stream): (usize, u32), block: u64, camera_ns: u64, arrives_ns: u64) {
        let arrival = Arrival {
            camera,
            stream,
            transfer: Transfer::Complete,
            block_id: BlockId(block),
            camera_ns,
            host_ns: HOST_NS + arrives_ns,
            pixels_crc: 0,
            taken: Instant::now(),
            block: Block::allocate(16),
        };
        self.accounting.frame_arrived(arrival, 0);
    }

    /// The clocks of the HSU and of the first camera are read.
    fn read_clocks(&mut self, device_time_ns: u64) {
        for camera in [None, Some(CameraId("c0".to_owned()))] {
            let host = HOST_NS + device_time_ns;
            let (host_send_ns, host_receive_ns) = (host - 50_000, host + 50_000);
            self.accounting.handle(RecorderCommand::Clock(ClockSample {
                camera,
                host_send_ns,
                host_receive_ns,
                device_time_ns,
            }));
        }
    }

    /// Whether a reading of the camera's clock was requested.
    fn was_asked(&self) -> bool {
        self.closed.try_iter().any(|event| matches!(event, RecorderEvent::Doubtful { camera: 0 }))
    }

    /// What every frame that waits has is all that will come.
    fn last_call(&mut self) {
        (0..self.accounting.lanes.len()).for_each(|camera| self.accounting.advance(camera, true));
    }

    fn outcomes(self) -> Outcomes {
        self.accounting.close(None);
        let closed = |event| matches!(event, RecorderEvent::Closed(_));
        assert!(self.closed.iter().any(closed), "it closes");
        self.outcomes.lock().expect("not poisoned").clone()
    }
}

/// Frames of two cameras that came before anything was triggered: of one before the recorder knew that, of the other
/// behind.
#[test]
fn what_came_before_the_silence_is_nobodys_and_ids_count_from_behind_it() {
    let mut desk = Desk::new(2);
    // Their stamps and ids would fit trigger 0.
    desk.frame(0, 0, 40, due(0) - 500_000_000);
    desk.accounting.handle(RecorderCommand::Silent { until_ns: HOST_NS + due(0) - 100_000_000 });
    desk.frame(1, 0, 7, due(0) - 400_000_000);
    for trigger in 0..20 {
        desk.report(trigger, due(trigger));
        desk.frame(0, 0, 41 + trigger, due(trigger));
        desk.frame(1, 0, 1 + trigger, due(trigger));
    }
    let outcomes = desk.outcomes();
    assert_eq!(outcomes.len(), 40);
    for trigger in 0..20 {
        let blocks = (outcomes[&(trigger, 0)], outcomes[&(trigger, 1)]);
        assert_eq!(blocks, (Ok(41 + trigger), Ok(1 + trigger)), "{trigger}");
    }
}

/// The process stood still until some 40 ms after trigger 0, and its first report came later: camera 1 has lost a
/// frame of that time, and one long after it.
#[test]
fn a_pause_before_the_first_report_breaks_whole_sets() {
    let mut desk = Desk::new(2);
    (0..8).for_each(|k| desk.read_clocks(900_000_000 + k * 1_000_000));
    desk.accounting.paused(Duration::from_millis(300), "it stood still", HOST_NS + due(0) + 5 * PERIOD_NS);
    for trigger in 0..40 {
        desk.report(trigger, due(trigger));
        desk.frame(0, 0, trigger + 1, due(trigger));
        if ![3, 30].contains(&trigger) {
            desk.frame(1, 0, trigger + 1, due(trigger));
        }
    }
    let outcomes = desk.outcomes();
    assert_eq!(outcomes.len(), 80);
    for trigger in 0..40 {
        let expected = match trigger {
            3 => (Err(GapCause::NodePaused), Err(GapCause::NodePaused)),
            30 => (Ok(31), Err(GapCause::MissingPackets)),
            _ => (Ok(trigger + 1), Ok(trigger + 1)),
        };
        assert_eq!((outcomes[&(trigger, 0)], outcomes[&(trigger, 1)]), expected, "{trigger}");
    }
}

/// Of two cameras the second sends nothing in the warm-up.
#[test]
fn a_camera_whose_place_is_not_known_behind_the_warm_up_is_named_once() {
    let mut desk = Desk::warming_up(2, 8);
    let at = |number: i64| (2_000_000_000 + number * PERIOD_NS as i64) as u64;
    let reported = |desk: &Desk| -> Vec<(usize, Option<String>)> {
        let place = |event| match event {
            RecorderEvent::Place { camera, unknown } => Some((camera, unknown)),
            _ => None,
        };
        desk.closed.try_iter().filter_map(place).collect()
    };
    for number in -8..40i64 {
        desk.report_numbered(number, at(number));
        desk.frame(0, 0, (number + 9) as u64, at(number));
        match number {
            ..=4 => assert_eq!(reported(&desk), [], "{number}: it may come late"),
            5 => desk.accounting.awake += Duration::from_millis(450),
            6 => {
                let places = reported(&desk);
                assert_eq!(places.len(), 1, "{places:?}");
                let (camera, why) = &places[0];
                assert_eq!(*camera, 1);
                assert!(why.as_ref().is_some_and(|why| why.contains("no frame has come")), "{why:?}");
            }
            _ => assert_eq!(reported(&desk), [], "{number}: once"),
        }
    }
}

fn due(trigger: u64) -> u64 {
    1_000_000_000 + trigger * PERIOD_NS
}

/// A frame of the old stream that was on its way when the camera was lost still counts, until the camera is back: it
/// must not pass for one of the fresh stream, whose ids and clock are others.
#[test]
fn frames_of_a_stream_that_has_ended_are_not_taken_for_later_ones() {
    let mut desk = Desk::new(2);
    for trigger in 0..80 {
        desk.report(trigger, due(trigger));
        desk.frame(1, 0, trigger + 1, due(trigger));
        match trigger {
            0..40 => desk.frame(0, 0, trigger + 1, due(trigger)),
            40 => desk.accounting.handle(RecorderCommand::CameraLost(0, GapCause::ControlLost)),
            45 => desk.frame(0, 0, 41, due(40)),
            50 => desk.accounting.handle(RecorderCommand::CameraBack { camera: 0, stream: 1 }),
            55 => desk.frame(0, 0, 42, due(41)),
            60.. => desk.frame(0, 1, trigger - 59, due(trigger)),
            _ => {}
        }
    }
    let outcomes = desk.outcomes();
    assert_eq!(outcomes.len(), 160);
    for trigger in 0..80 {
        let expected = match trigger {
            0..=40 => Ok(trigger + 1),
            60.. => Ok(trigger - 59),
            _ => Err(GapCause::ControlLost),
        };
        assert_eq!(
            (outcomes[&(trigger, 0)], outcomes[&(trigger, 1)]),
            (expected, Ok(trigger + 1)),
            "{trigger}"
        );
    }
}

/// Reports of triggers 40 to 69 are held up, and the train pauses before 50 and before 60.
fn pausing(cameras: usize) -> Outcomes {
    let mut desk = Desk::new(cameras);
    let pauses =
        |trigger: u64| u64::from(trigger >= 50) * 3 * PERIOD_NS + u64::from(trigger >= 60) * 2_500_000;
    for trigger in 0..100 {
        let at = due(trigger) + pauses(trigger);
        if trigger == 70 {
            for late in 40..70 {
                let flags = if [50, 60].contains(&late) { u32::from(TriggerFlags::LATE.0) } else { 0 };
                desk.report_flagged(late, due(late) + pauses(late), flags);
            }
        }
        if !(40..70).contains(&trigger) {
            desk.report(trigger, at);
        }
        (0..cameras).for_each(|camera| desk.frame(camera, 0, trigger + 1, at));
        if (40..70).contains(&trigger) {
            desk.last_call();
        }
    }
    desk.outcomes()
}

#[test]
fn two_cameras_stand_in_for_reports_of_a_train_that_pauses() {
    let outcomes = pausing(2);
    assert_eq!(outcomes.len(), 200);
    for ((trigger, camera), outcome) in outcomes {
        assert_eq!(outcome, Ok(trigger + 1), "camera {camera}");
    }
}

#[test]
fn one_camera_gives_up_what_it_cannot_tell() {
    let outcomes = pausing(1);
    assert_eq!(outcomes.len(), 100);
    for ((trigger, _), outcome) in outcomes {
        let given_up = (50..70).contains(&trigger);
        let expected = if given_up { Err(GapCause::IdentityMismatch) } else { Ok(trigger + 1) };
        assert_eq!(outcome, expected, "{trigger}");
    }
}

/// The link is lost at trigger 40 and back at 60: the report of 60 is there before those that were missed, and the
/// train was late meanwhile.
#[test]
fn two_cameras_stand_in_for_reports_that_are_still_missing_when_the_link_is_back() {
    let mut desk = Desk::new(2);
    let late = |trigger: u64| match trigger {
        0..45 => 0,
        45..58 => PERIOD_NS * 3 / 4,
        _ => PERIOD_NS * 6,
    };
    for trigger in 0..100 {
        let at = due(trigger) + late(trigger);
        if !(40..60).contains(&trigger) {
            desk.report(trigger, at);
        }
        if trigger == 60 {
            desk.last_call();
            (40..60).for_each(|missed| desk.report(missed, due(missed) + late(missed)));
        }
        (0..2).for_each(|camera| desk.frame(camera, 0, trigger + 1, at));
    }
    let outcomes = desk.outcomes();
    assert_eq!(outcomes.len(), 200);
    for ((trigger, camera), outcome) in outcomes {
        assert_eq!(outcome, Ok(trigger + 1), "camera {camera}");
    }
}

/// The serial line is slow now in one direction, now in the other, and then silent for five seconds: the HSU's clock
/// is known less well than the later timestamps of the cameras.
#[test]
fn a_link_that_is_silent_for_seconds_costs_no_frame() {
    let mut desk = Desk::new(2);
    let read = |desk: &mut Desk, camera: Option<&str>, device_time_ns: u64, (there, back): (u64, u64)| {
        let host = HOST_NS + device_time_ns;
        let camera = camera.map(|id| CameraId(id.to_owned()));
        let (host_send_ns, host_receive_ns) = (host - there, host + back);
        let sample = ClockSample { camera, host_send_ns, host_receive_ns, device_time_ns };
        desk.accounting.handle(RecorderCommand::Clock(sample));
    };
    for k in 0..20 {
        let slow = k * 40_000;
        read(&mut desk, None, 500_000_000 + k * 25_000_000, (100_000 + slow, 900_000 - slow));
    }
    let held = 60..660;
    for trigger in 0..700 {
        if trigger % 20 == 0 {
            read(&mut desk, Some("c0"), due(trigger), (50_000, 50_000));
            read(&mut desk, Some("c1"), due(trigger), (50_000, 50_000));
        }
        desk.report_held(trigger, &held);
        (0..2).for_each(|camera| desk.frame(camera, 0, trigger + 1, due(trigger)));
        if held.contains(&trigger) {
            desk.last_call();
        }
    }
    let outcomes = desk.outcomes();
    assert_eq!(outcomes.len(), 1400);
    for ((trigger, camera), outcome) in outcomes {
        assert_eq!(outcome, Ok(trigger + 1), "camera {camera}");
    }
}

/// While reports are held up, frames of one trigger arrive nearly a period late: those behind them are in time,
/// though their triggers are not reported either.
#[test]
fn a_frame_that_comes_late_while_reports_are_held_up_costs_nothing() {
    let mut desk = Desk::new(2);
    let held = 40..70;
    for trigger in 0..90 {
        desk.report_held(trigger, &held);
        // Before the next trigger is due, so that nothing is expected behind it.
        let late_ns = if trigger == 50 { 7_000_000 } else { 0 };
        for camera in 0..2 {
            let arrives_ns = due(trigger) + 500_000 + late_ns;
            desk.frame_stamped((camera, 0), trigger + 1, due(trigger), arrives_ns);
        }
        if trigger == held.end - 1 {
            desk.last_call();
        }
    }
    let outcomes = desk.outcomes();
    assert_eq!(outcomes.len(), 180);
    for ((trigger, camera), outcome) in outcomes {
        assert_eq!(outcome, Ok(trigger + 1), "camera {camera}");
    }
}

/// While reports are held up, two of four cameras ignore a trigger each, and the others lose frames just then: that
/// the two agree with each other files none of their frames one trigger too early.
#[test]
fn two_cameras_that_ignored_as_many_triggers_are_not_believed() {
    let mut desk = Desk::new(4);
    let held = 40..70;
    let (ignored, lost) = ([43, 46], 44..47);
    for trigger in 0..90 {
        desk.report_held(trigger, &held);
        for camera in 0..4 {
            let missed = ignored.get(camera).is_some_and(|ignored| trigger > *ignored);
            let arrives_ns = due(trigger) + 500_000;
            if ignored.get(camera) != Some(&trigger) && !(camera > 1 && lost.contains(&trigger)) {
                let block = trigger + 1 - u64::from(missed);
                desk.frame_stamped((camera, 0), block, due(trigger), arrives_ns);
            }
        }
        if trigger == held.end - 1 {
            desk.last_call();
        }
    }
    let outcomes = desk.outcomes();
    assert_eq!(outcomes.len(), 360);
    let mut kept = 0;
    for ((trigger, camera), outcome) in outcomes {
        let missed = ignored.get(camera).is_some_and(|ignored| trigger > *ignored);
        let right = trigger + 1 - u64::from(missed);
        assert!(outcome.is_err() || outcome == Ok(right), "camera {camera}, trigger {trigger}: {outcome:?}");
        kept += usize::from(outcome.is_ok());
    }
    assert!(kept >= 280, "{kept}");
}

/// A camera without timestamps is placed by the rhythm of its warm-up. The reports of that come late, when frames
/// behind it are there: these came in fits and starts, which takes nothing from the rhythm before them.
#[test]
fn a_host_that_is_busy_behind_the_warm_up_hides_no_rhythm() {
    let mut desk = Desk::warming_up(1, 8);
    let half = PERIOD_NS as i64 / 2;
    let at = |number: i64| {
        let pauses = [-6, -3, -2].iter().filter(|pause| number >= **pause).count() as i64;
        (2_000_000_000 + number * PERIOD_NS as i64 + pauses * half) as u64
    };
    for number in -8..60 {
        let late_ns = if (0..9).contains(&number) && number % 2 == 1 { 3_000_000 } else { 0 };
        desk.frame_stamped((0, 0), (number + 9) as u64, 0, at(number) + 500_000 + late_ns);
        match number {
            ..6 => {}
            6 => (-8..=6).for_each(|number| desk.report_numbered(number, at(number))),
            _ => desk.report_numbered(number, at(number)),
        }
    }
    let outcomes = desk.outcomes();
    assert_eq!(outcomes.len(), 60);
    // While the host is busy frames of such a camera are given up, and not for the rest of the session.
    let given_up = outcomes.values().filter(|outcome| **outcome == Err(GapCause::IdentityMismatch)).count();
    let kept = outcomes.iter().filter(|((trigger, _), outcome)| **outcome == Ok(trigger + 9)).count();
    assert!(given_up + kept == 60 && given_up <= 13, "{outcomes:?}");
    assert_eq!(outcomes[&(0, 0)], Ok(9));
}

/// Trigger 45 is ignored, and the timestamp of 49 is absurd: between them are too few frames for a host of which one in
/// thirty came late. Behind the absurd one counter and clock contradict each other as before it.
#[test]
fn one_absurd_timestamp_does_not_hide_what_the_frames_around_it_show() {
    let mut desk = Desk::new(1);
    for trigger in 0..80 {
        desk.report(trigger, due(trigger));
        let arrives_ns = due(trigger) + if trigger == 30 { 8_000_000 } else { 3_000_000 };
        let camera_ns = due(trigger) + if trigger == 49 { 35_000_000_000_000 } else { 0 };
        match trigger {
            0..45 => desk.frame_stamped((0, 0), trigger + 1, camera_ns, arrives_ns),
            45 => {}
            _ => desk.frame_stamped((0, 0), trigger, camera_ns, arrives_ns),
        }
    }
    let outcomes = desk.outcomes();
    assert_eq!(outcomes.len(), 80);
    for ((trigger, _), outcome) in outcomes {
        let expected = match trigger {
            0..45 => Ok(trigger + 1),
            45 => Err(GapCause::NotTriggered),
            _ => Ok(trigger),
        };
        assert_eq!(outcome, expected, "{trigger}");
    }
}

/// Both cameras' ids jump by one at trigger 42 while the reports of 40 to 59 are held up: they agree, and are wrong.
/// But no train fires a trigger before its time.
#[test]
fn cameras_that_agree_on_a_trigger_before_its_time_are_not_believed() {
    let mut desk = Desk::new(2);
    let block = |trigger: u64| trigger + 1 + u64::from(trigger >= 42);
    for trigger in 0..100 {
        if trigger == 60 {
            (40..60).for_each(|late| desk.report(late, due(late)));
        }
        if !(40..60).contains(&trigger) {
            desk.report(trigger, due(trigger));
        }
        (0..2).for_each(|camera| desk.frame(camera, 0, block(trigger), due(trigger)));
        if (40..60).contains(&trigger) {
            desk.last_call();
        }
    }
    let outcomes = desk.outcomes();
    assert_eq!(outcomes.len(), 200);
    for ((trigger, camera), outcome) in outcomes {
        assert!(outcome.is_err() || outcome == Ok(block(trigger)), "camera {camera}, {trigger}: {outcome:?}");
        assert!((42..60).contains(&trigger) || outcome.is_ok(), "camera {camera}, {trigger}: {outcome:?}");
    }
}

/// Ids jump by three: by the counter each frame would have arrived before its trigger, so clock and arrival outvote it.
#[test]
fn ids_that_jump_are_outvoted_by_the_clock_and_the_arrivals() {
    let mut desk = Desk::new(1);
    (0..8).for_each(|k| desk.read_clocks(900_000_000 + k * 1_000_000));
    let block = |trigger: u64| trigger + 1 + 3 * u64::from(trigger >= 30);
    for trigger in 0..40 {
        desk.report(trigger, due(trigger));
        desk.frame(0, 0, block(trigger), due(trigger));
    }
    assert!(desk.was_asked(), "how long it takes to stamp a frame is measured by readings");
    let outcomes = desk.outcomes();
    assert!(outcomes.iter().all(|((trigger, _), outcome)| *outcome == Ok(block(*trigger))), "{outcomes:?}");
}

/// Trigger 34 was ignored, the frames of 35 to 37 came and were given up, that of 38 was lost.
#[test]
fn given_up_frames_stand_at_their_clocks_triggers_where_the_next_frame_shows_that_some_were_ignored() {
    let mut desk = Desk::new(1);
    let lane = &mut desk.accounting.lanes[0];
    let skipped = |lane: &mut super::Lane, shown: &[(u64, Option<u64>)], ignored| {
        (lane.given_up_now, lane.given_up_at) = (3, shown.iter().copied().collect());
        let short = |cause| match cause {
            GapCause::IdentityMismatch => 'g',
            GapCause::NotTriggered => 'i',
            _ => 'l',
        };
        lane.skipped(34..39, GapCause::MissingPackets, ignored).into_iter().map(short).collect::<String>()
    };
    let disputed = [(34, Some(35)), (35, Some(36)), (36, Some(37))];
    assert_eq!(skipped(lane, &disputed, 1), "igggl");
    assert_eq!(skipped(lane, &disputed, 0), "gggll", "ids are right after all");
    let agreed = disputed.map(|(id, _)| (id, Some(id)));
    assert_eq!(skipped(lane, &agreed, 1), "gggli", "which of the two came first is not known");
    assert_eq!(skipped(lane, &[], 1), "lgggi", "nor where they are");
    assert_eq!(skipped(lane, &[(4, None), (4, None), (90, None)], 0), "llggg");
}
