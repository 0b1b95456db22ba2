// SPDX-License-Identifier: MIT OR Apache-2.0
//! `kill -9` of either node at each stage of a session (docs/design/operation.md): the test stands in for systemd and starts it again.

use crate::crash::{Random, number};
use crate::lab::{NodeProcess, capture_whole, fourdbody, laboratory, start_nodes, text_of};
use fourdbody::control::request::Phase;
use fourdbody::control::status::{NodeStatus, Outcome, path};
use fourdbody::record::SessionReader;
use fourdbody_simulator::laboratory::Laboratory;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::Output;
use std::time::{Duration, Instant};

/// The node that runs the capture; the other is 1.
pub(crate) const COORDINATOR: usize = 0;
/// More than any stage lasts.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);

/// When the node is killed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Stage {
    Preparing,
    CountingDown,
    Recording,
    /// Draining or closing, some milliseconds after the train has ended.
    Ending,
}

impl Stage {
    /// The capture that passes through it, and how long it is.
    fn wish(self, name: &str) -> Value {
        let (countdown_s, triggers) = match self {
            Self::CountingDown => (30, 6),
            Self::Recording => (0, 0),
            Self::Preparing | Self::Ending => (0, 8),
        };
        json!({ "wish": { "name": name, "triggers": triggers, "countdown_s": countdown_s } })
    }

    fn is_at(self, status: &NodeStatus) -> bool {
        let triggers = status.session.as_ref().map_or(0, |session| session.triggers);
        match self {
            Self::Preparing => status.phase == Phase::Preparing,
            Self::CountingDown => status.phase == Phase::Ready,
            Self::Recording => status.phase == Phase::Running && triggers > 15,
            Self::Ending => matches!(status.phase, Phase::Draining | Phase::Closing),
        }
    }
}

pub(crate) struct Rig {
    dir: tempfile::TempDir,
    pub(crate) laboratory: Laboratory,
    pub(crate) nodes: Vec<NodeProcess>,
}

impl Rig {
    pub(crate) fn new() -> Self {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let laboratory = laboratory(dir.path(), 20.0);
        let nodes = start_nodes(&laboratory);
        Self { dir, laboratory, nodes }
    }

    /// Runs a capture and kills the node in it; what the node said last, and whether it was at that stage.
    fn kill_in(&mut self, victim: usize, stage: Stage, name: &str, delay: Duration) -> Option<NodeStatus> {
        let asked = self.nodes[COORDINATOR].client.post(path::CAPTURE, &stage.wish(name), PATIENCE);
        asked.expect("the capture begins");
        let ours = |status: &NodeStatus| status.session.as_ref().is_some_and(|session| session.name == name);
        let deadline = Instant::now() + PATIENCE;
        loop {
            let status = self.nodes[victim].client.status().expect("it answers");
            let over = status.session.as_ref().is_some_and(|session| session.outcome.is_some());
            if ours(&status) && stage.is_at(&status) {
                std::thread::sleep(delay);
                self.nodes[victim].kill();
                return Some(status);
            }
            if ours(&status) && over {
                return None;
            }
            assert!(Instant::now() < deadline, "{name}: never at {stage:?}: {status:#?}");
            // A client may ask 200 times a second.
            std::thread::sleep(Duration::from_millis(8));
        }
    }

    /// Starts a killed node again, as systemd would.
    fn restart(&mut self, victim: usize) -> NodeStatus {
        let file = &self.laboratory.nodes[victim];
        self.nodes[victim] = NodeProcess::start(&file.path, file.port);
        self.nodes[victim].wait_ready()
    }

    /// The other node's session as it ended; `None` where it has never heard of it.
    pub(crate) fn end_of(&mut self, survivor: usize, name: &str) -> Option<Outcome> {
        let status = self.nodes[survivor].wait_until("idle, with an outcome", |status| {
            let session = status.session.as_ref().filter(|session| session.name == name);
            status.phase == Phase::Idle && session.is_none_or(|session| session.outcome.is_some())
        });
        status.session.filter(|session| session.name == name).and_then(|session| session.outcome)
    }

    /// A coordinator that lives waits some seconds for a node that does not.
    fn the_capture_has_ended(&self, name: &str) {
        let deadline = Instant::now() + PATIENCE;
        let running = || {
            let capture: Value = self.nodes[COORDINATOR].client.get(path::CAPTURE).expect("it answers");
            capture["running"] == true
        };
        while running() {
            assert!(Instant::now() < deadline, "{name}: the coordinator never gives up");
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    pub(crate) fn part(&self, name: &str, node: usize) -> PathBuf {
        self.dir.path().join("sessions").join(name).join(format!("node-{}", ["a", "b"][node]))
    }

    pub(crate) fn the_next_session_works(&mut self, name: &str) {
        self.nodes.iter_mut().for_each(|node| drop(node.wait_ready()));
        self.the_capture_has_ended(name);
        let captured = capture_whole(&self.laboratory, &format!("{name}-next"), 6, &[]);
        assert_eq!(captured.status.code(), Some(0), "after {name}: {}", text_of(&captured));
    }
}

fn verify(path: &Path) -> Output {
    fourdbody(&["verify", &path.display().to_string()])
}

/// Frames that can be read, whatever the state of the recording.
fn frames(part: &Path) -> u64 {
    use fourdbody::data::{Frame, FrameSource};
    let Ok(reader) = SessionReader::open(part) else { return 0 };
    let all = reader.triggers().flat_map(|t| reader.cameras().iter().map(move |c| (c.clone(), t)));
    let frame = |(camera, trigger)| reader.frame(&camera, fourdbody::base::ids::TriggerIndex(trigger));
    all.map(frame).filter(|frame| matches!(frame, Ok(Frame::Owned(_)))).count() as u64
}

/// Nothing recorded is lost: what a dead node left is named when it starts, and saved by the command that it names.
fn is_saved(status: &NodeStatus, part: &Path, name: &str) -> u64 {
    let there = frames(part);
    let Some(left) = status.interrupted.iter().find(|left| left.session.as_str() == name) else {
        // It had closed its recording, or had not begun one.
        let verified = verify(part);
        assert!(!part.exists() || verified.status.success(), "{}: {}", part.display(), text_of(&verified));
        return there;
    };
    if left.frames == 0 {
        return 0;
    }
    let out = part.with_file_name("recovered");
    let (from, to) = (part.display().to_string(), out.display().to_string());
    let recovered = fourdbody(&["recover", &from, "--out", &to]);
    assert!(matches!(recovered.status.code(), Some(0 | 3)), "{}", text_of(&recovered));
    let verified = verify(&out);
    assert!(matches!(verified.status.code(), Some(0 | 3)), "{}", text_of(&verified));
    assert_eq!(frames(&out), there, "a frame that was on the disk is in what was saved");
    there
}

#[test]
fn a_node_that_is_killed_before_the_first_trigger_leaves_nobody_waiting() {
    let mut rig = Rig::new();
    for stage in [Stage::Preparing, Stage::CountingDown] {
        for victim in [COORDINATOR, 1] {
            let name = format!("{stage:?}-{victim}").to_lowercase();
            rig.kill_in(victim, stage, &name, Duration::ZERO).expect("the stage lasts long enough");
            let status = rig.restart(victim);
            let survivor = 1 - victim;
            let outcome = rig.end_of(survivor, &name);
            assert!(!matches!(outcome, Some(Outcome::Recorded(_))), "{name}: {outcome:?}");
            assert!(
                !rig.part(&name, survivor).exists(),
                "{name}: a session without a trigger leaves nothing"
            );
            assert_eq!(is_saved(&status, &rig.part(&name, victim), &name), 0, "{name}");
            rig.the_next_session_works(&name);
        }
    }
}

#[test]
fn a_node_that_is_killed_while_recording_loses_nothing_that_was_on_the_disk() {
    let mut rig = Rig::new();
    for victim in [COORDINATOR, 1] {
        let name = format!("recording-{victim}");
        let last =
            rig.kill_in(victim, Stage::Recording, &name, Duration::ZERO).expect("it runs until stopped");
        let status = rig.restart(victim);
        let Some(Outcome::Recorded(verdict)) = rig.end_of(1 - victim, &name) else { panic!("{name}") };
        assert!(verdict["aborted"].is_string(), "{name}: {verdict:#}");
        let verified = verify(&rig.part(&name, 1 - victim));
        assert!(matches!(verified.status.code(), Some(0 | 3)), "{name}: {}", text_of(&verified));
        // The first segment's header and the chunks of half a second are older than the stated bound of one.
        let (triggers, saved) =
            (last.session.map_or(0, |s| s.triggers), is_saved(&status, &rig.part(&name, victim), &name));
        assert!(saved > 0, "{name}: nothing of {triggers} triggers");
        rig.the_next_session_works(&name);
    }
}

#[test]
fn a_node_that_is_killed_after_the_last_trigger_costs_the_other_nothing() {
    let mut rig = Rig::new();
    let mut random = Random(number("FOURDBODY_SEED", 5));
    let mut at_the_end = 0;
    for round in 0..6 {
        let victim = round % 2;
        let name = format!("ending-{round}");
        let delay = Duration::from_millis(random.below(60));
        if rig.kill_in(victim, Stage::Ending, &name, delay).is_none() {
            continue;
        }
        at_the_end += 1;
        let status = rig.restart(victim);
        let Some(Outcome::Recorded(verdict)) = rig.end_of(1 - victim, &name) else { panic!("{name}") };
        assert_eq!(verdict["status"], "complete", "{name}: {verdict:#}");
        let saved = is_saved(&status, &rig.part(&name, victim), &name);
        assert!(saved > 0, "{name}: killed {delay:?} after its train had ended, with {saved} of 32 frames");
        rig.the_next_session_works(&name);
    }
    assert!(at_the_end >= 2, "only {at_the_end} of 6 sessions were seen at their end");
}
