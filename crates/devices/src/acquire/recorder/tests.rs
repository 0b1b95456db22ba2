// SPDX-License-Identifier: MIT OR Apache-2.0
//! The recorder behind a disk that is too slow: whole sets go, all are accounted for, the rest is intact.

use super::{Channels, LaneSetup, Progress, Recorder, RecorderCommand, RecorderEvent, RecorderOptions};
use crate::acquire::preview::Taps;
use crate::acquire::receiver::Arrival;
use crate::acquire::writer_queue::{Sink, ToWriter};
use crate::base::ids::{BlockId, CameraId, TriggerIndex};
use crate::camera::Transfer;
use crate::config::WhenFull;
use crate::host::frame_memory::Block;
use crate::matcher::{Matcher, Start};
use crate::record::{GapCause, RecordError, SessionEnd, TriggerRecord, Verdict};
use crossbeam_channel::{Receiver, Sender, bounded, unbounded};
use std::collections::BTreeMap;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

const PERIOD_NS: u64 = 8_333_333;
const CAMERAS: usize = 4;

type Outcomes = Arc<Mutex<BTreeMap<(u64, usize), Option<GapCause>>>>;

/// Takes a frame only with a token; keeps the accounting as a recording does.
struct SlowSink {
    tokens: Receiver<()>,
    outcomes: Outcomes,
    events: Sender<String>,
}

impl Sink for SlowSink {
    fn write(&mut self, item: ToWriter) -> Result<(), RecordError> {
        let mut outcomes = self.outcomes.lock().expect("not poisoned");
        let (key, outcome) = match item {
            ToWriter::Frame(frame) => {
                drop(outcomes);
                // Closed means: from now on as fast as can be.
                let _ = self.tokens.recv();
                outcomes = self.outcomes.lock().expect("not poisoned");
                assert_eq!(u64::from(frame.block.pixels()[0]), frame.meta.trigger.0 % 251);
                ((frame.meta.trigger.0, frame.camera), None)
            }
            ToWriter::Gap(camera, trigger, cause) => ((trigger.0, camera), Some(cause)),
            ToWriter::Event(event) => {
                let _ = self.events.send(event.kind);
                return Ok(());
            }
            _ => return Ok(()),
        };
        assert_eq!(outcomes.insert(key, outcome), None, "a second outcome for {key:?}");
        Ok(())
    }

    fn finish(self: Box<Self>, _: SessionEnd) -> Result<Verdict, RecordError> {
        Err(RecordError::Stopped { reason: "a stand-in has no verdict".to_owned() })
    }
}

fn lane(camera: usize) -> LaneSetup {
    let start = Start { period_ns: PERIOD_NS, warm_up: 0, hsu_minus_host_ns: Some(0) };
    let id = CameraId(format!("c{camera}"));
    LaneSetup { id, width: 16, height: 1, matcher: Matcher::new(start) }
}

fn due(trigger: u64) -> u64 {
    1_000_000_000 + trigger * PERIOD_NS
}

fn arrival(camera: usize, trigger: u64) -> Arrival {
    let mut block = Block::allocate(16);
    block.bytes_mut()[crate::host::frame_memory::ROOM_BYTES] = (trigger % 251) as u8;
    Arrival {
        camera,
        stream: 0,
        transfer: Transfer::Complete,
        block_id: BlockId(trigger + 1),
        camera_ns: due(trigger),
        host_ns: due(trigger) + 3_000_000,
        pixels_crc: 0,
        taken: Instant::now(),
        block,
    }
}

struct Run {
    outcomes: BTreeMap<(u64, usize), Option<GapCause>>,
    kinds: Vec<String>,
    progress: Arc<Progress>,
    ring_full: usize,
}

/// `triggers` sets, with the disk standing still for the first `stalled` of them.
fn run(triggers: u64, stalled: u64, when_full: WhenFull) -> Run {
    let outcomes = Outcomes::default();
    let (token, tokens) = unbounded();
    let (kinds_in, kinds) = unbounded();
    let sink = SlowSink { tokens, outcomes: Arc::clone(&outcomes), events: kinds_in };
    let progress = Arc::new(Progress::new(CAMERAS));
    let (arrivals_in, arrivals) = bounded(10_000);
    let (commands_in, commands) = unbounded();
    let (events_in, events) = unbounded();
    let options = RecorderOptions {
        report_patience: Duration::from_secs(600),
        set_patience: Duration::from_secs(600),
        ..RecorderOptions::new(PERIOD_NS, 32, when_full)
    };
    let lanes = (0..CAMERAS).map(lane).collect();
    let shared = Arc::clone(&progress);
    let channels = Channels { arrivals, commands, events: events_in };
    let thread = Recorder::start(Box::new(sink), Taps::of_nobody(), lanes, options, shared, channels)
        .expect("threads start");
    let mut token = Some(token);
    for trigger in 0..triggers {
        if trigger == stalled {
            token = None;
            wait(|| outcomes.lock().expect("not poisoned").len() as u64 == stalled * CAMERAS as u64);
        }
        let record = TriggerRecord {
            index: TriggerIndex(trigger),
            hsu_time_ns: due(trigger),
            flags: 0,
            host_time_ns: 0,
        };
        commands_in.send(RecorderCommand::Trigger(record)).expect("it runs");
        wait(|| progress.triggers.load(Ordering::Relaxed) > trigger);
        for camera in 0..CAMERAS {
            arrivals_in.send(arrival(camera, trigger)).expect("it runs");
        }
        wait(|| progress.latencies.matched.count() == (trigger + 1) * CAMERAS as u64);
        if trigger >= stalled {
            // However slow the machine is, it is the disk that was too slow, not the test's threads.
            let all = (trigger + 1) as usize * CAMERAS;
            wait(|| outcomes.lock().expect("not poisoned").len() == all);
        }
    }
    drop(token);
    commands_in.send(RecorderCommand::Drain { emitted: Some(triggers) }).expect("it runs");
    commands_in.send(RecorderCommand::Close { aborted: None }).expect("it runs");
    thread.join().expect("no panic");
    let ring_full = events.try_iter().filter(|event| matches!(event, RecorderEvent::RingFull { .. })).count();
    let outcomes = outcomes.lock().expect("not poisoned").clone();
    Run { outcomes, kinds: kinds.try_iter().collect(), progress, ring_full }
}

fn wait(mut until: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !until() {
        assert!(begun.elapsed() < Duration::from_secs(60), "nothing happens");
        std::thread::sleep(Duration::from_micros(200));
    }
}

#[test]
fn a_full_ring_costs_whole_sets_and_every_one_is_accounted_for() {
    let run = run(100, 50, WhenFull::DropFrameSet);
    assert_eq!(run.outcomes.len(), 100 * CAMERAS);
    let mut dropped = 0;
    for trigger in 0..100 {
        let causes: Vec<_> = (0..CAMERAS).map(|camera| run.outcomes[&(trigger, camera)]).collect();
        assert!(causes.iter().all(|cause| *cause == causes[0]), "trigger {trigger} is torn: {causes:?}");
        match causes[0] {
            None => {}
            Some(cause) => {
                assert_eq!(cause, GapCause::DroppedRingFull);
                assert!((12..50).contains(&trigger), "trigger {trigger} had room");
                dropped += 1;
            }
        }
    }
    // 32 blocks: 12 sets in the ring; the frame that the disk holds counts.
    assert_eq!(dropped, 38);
    assert_eq!(run.progress.ring_high_water.load(Ordering::Relaxed), 12 * CAMERAS as u64);
    assert_eq!(run.progress.dropped.load(Ordering::Relaxed), 38 * CAMERAS as u64);
    assert_eq!(run.kinds.iter().filter(|kind| *kind == "ring_full").count(), 1, "{:?}", run.kinds);
    assert_eq!(run.kinds.iter().filter(|kind| *kind == "latency").count(), 1);
    assert_eq!(run.ring_full, 0);
}

#[test]
fn a_full_ring_can_stop_the_session() {
    assert_eq!(run(30, 30, WhenFull::Stop).ring_full, 1);
    assert_eq!(run(10, 10, WhenFull::Stop).ring_full, 0);
}
