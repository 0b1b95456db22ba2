// SPDX-License-Identifier: MIT OR Apache-2.0
//! The session state machine of one node: `step(state, event, now) -> actions`, pure, without devices.
//!
//! ```text
//!  Idle --Prepare--> Preparing --all steps done--> Ready --first trigger--> Running --train ends--> Draining
//!   ^                    |  failure: undo           |  abort, timeout: undo    |  fault: stop train     |
//!   +--------------------+--------------------------+                          v                        v
//!   +<--------------------------------- recording closed -------------------- Draining --all in--> Closing
//! ```
//!
//! Where seconds before Record are wanted it is Ready --first trigger--> Holding --Record--> Running; whatever else
//! ends Holding is undone, as in Ready.
//!
//! Invariants: an action that acquires something is undone by exactly one later action, whatever happens in
//! between; a recording that saw a trigger is closed with a verdict, one that saw none is discarded; the
//! train is started only when this node and, by the HSU, every other node is ready.

use crate::base::{Exit, Fault};
use crate::control::request::{KeepRequest, Phase, SessionRequest};
use std::time::Duration;

/// What has happened to the session, its devices or its operator's requests.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Event {
    /// An operator requests a session.
    Prepare(SessionRequest),
    /// The action just carried out during preparation succeeded.
    StepDone,
    /// The action just carried out failed, or a device failed by itself.
    Failed(Fault),
    /// An operator starts the train from this node.
    Start,
    /// The HSU reports a trigger.
    Trigger,
    /// An operator wants to keep what is held, from a trigger of the train on.
    Keep(KeepRequest),
    /// The HSU reports the end of the train.
    TrainDone {
        /// How many triggers it emitted.
        emitted: u64,
    },
    /// The link to the HSU is lost, and is being restored: the train goes on meanwhile.
    LinkLost,
    LinkBack,
    /// Every camera has an outcome for every trigger, or will not get one any more.
    Drained,
    /// The recording is closed (with a verdict, which the driver keeps) or discarded.
    Closed,
    /// An operator ends the train after the current trigger.
    Stop,
    /// An operator, or the other node's failure, gives the session up.
    Abort(String),
    Tick,
}

/// What the driver must do, in this order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Action {
    /// Open what is not open, apply and read back settings, connect to the HSU.
    PrepareDevices,
    CreateRecording,
    /// Start fresh streams on all cameras.
    StartStreams,
    /// Make sure that no camera sends without a trigger.
    SilenceGate,
    /// Configure and arm this node's link of the HSU.
    ArmHsu,
    /// Answer the operator that the node is ready.
    ReportReady,
    /// Answer the operator that preparation failed, with the reason.
    ReportFailed(Fault),
    /// Request the train from the HSU.
    StartTrain,
    /// Request from the HSU to end the train after the current trigger.
    StopTrain,
    /// Take this node's arming back.
    DisarmHsu,
    StopStreams,
    /// Remove the recording: no trigger was seen.
    DiscardRecording,
    /// Record what is held, and what comes.
    Keep(KeepRequest),
    /// Wait for the frames of all triggers.
    Drain {
        /// How many triggers there were, where the HSU reported it.
        emitted: Option<u64>,
    },
    /// Write gap records and verdict, and close the recording.
    CloseRecording {
        /// Why the session did not end as requested.
        aborted: Option<String>,
    },
}

/// A node that is ready but is not started gives up after this time.
pub const READY_TIMEOUT: Duration = Duration::from_secs(120);
/// Frames are held no longer than this without Record, so that the projectors are not lit in vain.
pub const HOLD_TIMEOUT: Duration = Duration::from_secs(30 * 60);
/// A train without a reported trigger for this time (or 20 periods, if longer) has failed.
pub const SILENCE_TIMEOUT: Duration = Duration::from_secs(3);
/// Longest time to wait for a link to the HSU that was lost during a train.
pub const LINK_TIMEOUT: Duration = Duration::from_secs(60);
/// The end of a train is waited for no longer than this (or 200 periods, if longer): a node that broke off without its
/// link to the HSU cannot stop the train, and frames may come for as long as the other node lets it run.
pub const DRAIN_TIMEOUT: Duration = Duration::from_secs(10);

/// The state of one node's session. The node's thread makes one at its start and owns it as long as it lives. Given
/// the same events and times it returns the same actions; it never undoes an action twice, and every recording that
/// saw a trigger is closed with a verdict. It is idle again when the session has ended.
#[derive(Debug, Clone)]
pub struct Machine {
    phase: Phase,
    /// How many steps of the preparation are done.
    done: usize,
    request: Option<SessionRequest>,
    aborted: Option<String>,
    last_activity: Duration,
    silence_timeout: Duration,
    drain_timeout: Duration,
    /// When it was last not [`Phase::Draining`], and not [`Phase::Holding`].
    draining_since: Duration,
    holding_since: Duration,
    link_lost: bool,
}

/// The steps of preparation, in order, each with what undoes it.
const STEPS: [(Action, Option<Action>); 5] = [
    (Action::PrepareDevices, None),
    (Action::CreateRecording, Some(Action::DiscardRecording)),
    (Action::StartStreams, Some(Action::StopStreams)),
    (Action::SilenceGate, None),
    (Action::ArmHsu, Some(Action::DisarmHsu)),
];

impl Machine {
    /// An idle node with this trigger period.
    pub fn new(period: Duration) -> Self {
        Self {
            phase: Phase::Idle,
            done: 0,
            request: None,
            aborted: None,
            last_activity: Duration::ZERO,
            silence_timeout: SILENCE_TIMEOUT.max(period * 20),
            drain_timeout: DRAIN_TIMEOUT.max(period * 200),
            draining_since: Duration::ZERO,
            holding_since: Duration::ZERO,
            link_lost: false,
        }
    }

    /// The phase of the session that the node is in.
    pub fn phase(&self) -> Phase {
        self.phase
    }

    /// Whether the HSU is expected to report triggers.
    pub fn train_runs(&self) -> bool {
        matches!(self.phase, Phase::Holding | Phase::Running)
    }

    /// The session it is in.
    pub fn request(&self) -> Option<&SessionRequest> {
        self.request.as_ref()
    }

    /// Takes an event at `now` (monotonic) and returns what to do. Events that mean nothing in a phase change nothing.
    pub fn step(&mut self, event: Event, now: Duration) -> Vec<Action> {
        if !matches!(event, Event::Tick) {
            self.last_activity = now;
        }
        if self.phase != Phase::Draining {
            self.draining_since = now;
        }
        if self.phase != Phase::Holding {
            self.holding_since = now;
        }
        match (self.phase, event) {
            (Phase::Idle, Event::Prepare(request)) => {
                self.phase = Phase::Preparing;
                self.request = Some(request);
                self.aborted = None;
                vec![STEPS[0].0.clone()]
            }
            (Phase::Preparing, Event::StepDone) => self.next_step(),
            (Phase::Preparing | Phase::Ready, Event::Failed(fault)) => self.undo(fault),
            (Phase::Preparing, Event::Abort(reason)) => self.undo(Fault::new(Exit::Failure, reason)),
            (Phase::Ready, Event::Start) => vec![Action::StartTrain],
            (Phase::Ready, Event::Trigger) => {
                let holds = self.request.as_ref().is_some_and(|request| request.pre_triggers > 0);
                self.phase = if holds { Phase::Holding } else { Phase::Running };
                Vec::new()
            }
            (Phase::Holding, Event::Keep(keep)) => {
                self.phase = Phase::Running;
                vec![Action::Keep(keep)]
            }
            (Phase::Ready, Event::Abort(reason)) => self.give_up(reason),
            // It may have been started from another node, or the first report is on its way: the HSU knows, and
            // answers with the end of a train that may be empty.
            (Phase::Ready, Event::Stop) => vec![Action::StopTrain],
            // All telemetry of a short train may be lost: its end shows that it ran.
            (Phase::Ready, Event::TrainDone { emitted: 0 }) => self.give_up(
                "the train ended before its first trigger: another node gave up, or it was stopped"
                    .to_owned(),
            ),
            (Phase::Ready, Event::Tick) if self.idle_for(now) > READY_TIMEOUT => {
                self.give_up(format!("the session was not started within {} s", READY_TIMEOUT.as_secs()))
            }
            // Nothing was kept, so nothing is recorded.
            (Phase::Holding, Event::TrainDone { .. }) => self.give_up(
                "the train ended before Record was pressed: it was stopped, or another node gave up"
                    .to_owned(),
            ),
            (Phase::Ready | Phase::Running, Event::TrainDone { emitted }) => {
                self.phase = Phase::Draining;
                vec![Action::Drain { emitted: Some(emitted) }]
            }
            (Phase::Holding | Phase::Running, Event::Stop) => vec![Action::StopTrain],
            (Phase::Ready, Event::LinkLost) => self.give_up("the link to the HSU was lost".to_owned()),
            (Phase::Holding | Phase::Running, Event::LinkLost) => {
                self.link_lost = true;
                Vec::new()
            }
            (_, Event::LinkBack) => {
                self.link_lost = false;
                Vec::new()
            }
            (Phase::Holding, Event::Failed(Fault { message: reason, .. }) | Event::Abort(reason)) => {
                self.let_go(reason)
            }
            (Phase::Holding, Event::Tick) if now.saturating_sub(self.holding_since) > HOLD_TIMEOUT => {
                self.let_go(format!("Record was not pressed within {} min", HOLD_TIMEOUT.as_secs() / 60))
            }
            (Phase::Holding, Event::Tick) if self.idle_for(now) > self.patience() => {
                self.let_go(self.silence(now))
            }
            (Phase::Running, Event::Failed(Fault { message: reason, .. }) | Event::Abort(reason)) => {
                self.break_off(reason)
            }
            (Phase::Running, Event::Tick) if self.idle_for(now) > self.patience() => {
                self.break_off(self.silence(now))
            }
            (Phase::Draining, Event::Drained) => self.close(),
            (Phase::Draining, Event::Tick)
                if now.saturating_sub(self.draining_since) > self.drain_timeout =>
            {
                self.close()
            }
            (Phase::Draining, Event::TrainDone { emitted }) => vec![Action::Drain { emitted: Some(emitted) }],
            // The node that received the abort first has ended the train for both.
            (Phase::Draining, Event::Failed(Fault { message: reason, .. }) | Event::Abort(reason)) => {
                self.aborted.get_or_insert(reason);
                Vec::new()
            }
            (Phase::Closing, Event::Closed) => {
                self.reset();
                Vec::new()
            }
            _ => Vec::new(),
        }
    }

    /// How long a train may stay silent.
    fn patience(&self) -> Duration {
        if self.link_lost { self.silence_timeout.max(LINK_TIMEOUT) } else { self.silence_timeout }
    }

    fn idle_for(&self, now: Duration) -> Duration {
        now.saturating_sub(self.last_activity)
    }

    fn next_step(&mut self) -> Vec<Action> {
        self.done += 1;
        match STEPS.get(self.done) {
            Some((next, _)) => vec![next.clone()],
            None => {
                self.phase = Phase::Ready;
                vec![Action::ReportReady]
            }
        }
    }

    /// Undoes what was done, last first, and is idle again.
    fn undo(&mut self, fault: Fault) -> Vec<Action> {
        let undoing = STEPS[..self.done].iter().rev().filter_map(|(_, undo)| undo.clone());
        let actions = undoing.chain([Action::ReportFailed(fault)]).collect();
        self.reset();
        actions
    }

    fn give_up(&mut self, reason: String) -> Vec<Action> {
        self.undo(Fault::new(Exit::Device, reason))
    }

    fn silence(&self, now: Duration) -> String {
        let silent_s = self.idle_for(now).as_secs_f64();
        format!("the HSU reported no trigger for {silent_s:.1} s; check its serial link")
    }

    /// Ends a train of which nothing was kept.
    fn let_go(&mut self, reason: String) -> Vec<Action> {
        let undo = self.give_up(reason);
        std::iter::once(Action::StopTrain).chain(undo).collect()
    }

    /// Ends a running train early; what was recorded is kept.
    fn break_off(&mut self, reason: String) -> Vec<Action> {
        self.aborted = Some(reason);
        self.phase = Phase::Draining;
        vec![Action::StopTrain, Action::Drain { emitted: None }]
    }

    fn close(&mut self) -> Vec<Action> {
        self.phase = Phase::Closing;
        let aborted = self.aborted.take();
        vec![Action::StopStreams, Action::DisarmHsu, Action::CloseRecording { aborted }]
    }

    fn reset(&mut self) {
        self.phase = Phase::Idle;
        self.done = 0;
        self.link_lost = false;
        self.request = None;
    }
}

#[cfg(test)]
mod tests {
    use super::{Action, DRAIN_TIMEOUT, Event, HOLD_TIMEOUT, Machine, READY_TIMEOUT};
    use crate::base::ids::NodeId;
    use crate::base::{Exit, Fault};
    use crate::control::request::{KeepRequest, Phase, SessionRequest};
    use proptest::prelude::{
        Just, ProptestConfig, Strategy, prop_assert, prop_assert_eq, prop_oneof, proptest,
    };
    use std::time::Duration;

    fn request() -> SessionRequest {
        SessionRequest {
            session_id: 7,
            name: "walk".to_owned(),
            triggers: 24,
            nodes: vec![NodeId::from("a"), NodeId::from("b")],
            subject: None,
            note: None,
            start_on: None,
            pre_triggers: 0,
            dry_run: false,
            preview: false,
            on_behalf_of: None,
        }
    }

    fn machine() -> Machine {
        Machine::new(Duration::from_millis(8))
    }

    fn fault() -> Fault {
        Fault::new(Exit::Device, "unplugged")
    }

    fn ready() -> Machine {
        let mut machine = machine();
        machine.step(Event::Prepare(request()), Duration::ZERO);
        (0..5).for_each(|_| drop(machine.step(Event::StepDone, Duration::ZERO)));
        assert_eq!(machine.phase(), Phase::Ready);
        machine
    }

    #[test]
    fn a_session_goes_through_all_phases() {
        let mut m = machine();
        let t = Duration::ZERO;
        assert_eq!(m.step(Event::Prepare(request()), t), [Action::PrepareDevices]);
        assert_eq!(m.step(Event::StepDone, t), [Action::CreateRecording]);
        assert_eq!(m.step(Event::StepDone, t), [Action::StartStreams]);
        assert_eq!(m.step(Event::StepDone, t), [Action::SilenceGate]);
        assert_eq!(m.step(Event::StepDone, t), [Action::ArmHsu]);
        assert_eq!(m.step(Event::StepDone, t), [Action::ReportReady]);
        assert_eq!(m.step(Event::Start, t), [Action::StartTrain]);
        assert_eq!(m.step(Event::Trigger, t), []);
        assert_eq!(m.step(Event::TrainDone { emitted: 24 }, t), [Action::Drain { emitted: Some(24) }]);
        let close = Action::CloseRecording { aborted: None };
        assert_eq!(m.step(Event::Drained, t), [Action::StopStreams, Action::DisarmHsu, close]);
        assert_eq!(m.step(Event::Closed, t), []);
        assert_eq!(m.phase(), Phase::Idle);
    }

    #[test]
    fn a_failed_step_undoes_those_before_it() {
        let mut m = machine();
        m.step(Event::Prepare(request()), Duration::ZERO);
        m.step(Event::StepDone, Duration::ZERO);
        m.step(Event::StepDone, Duration::ZERO);
        let actions = m.step(Event::Failed(fault()), Duration::ZERO);
        assert_eq!(actions, [Action::DiscardRecording, Action::ReportFailed(fault())]);
        assert_eq!(m.phase(), Phase::Idle);
    }

    #[test]
    fn what_fails_before_the_start_is_told_as_it_is() {
        let fault = Fault::new(Exit::Failure, "the disk cannot be written");
        let actions = ready().step(Event::Failed(fault.clone()), Duration::ZERO);
        assert_eq!(actions.last(), Some(&Action::ReportFailed(fault)));
    }

    #[test]
    fn a_node_that_is_never_started_gives_up() {
        let mut m = ready();
        assert_eq!(m.step(Event::Tick, READY_TIMEOUT), []);
        let actions = m.step(Event::Tick, READY_TIMEOUT + Duration::from_secs(1));
        assert_eq!(actions[..3], [Action::DisarmHsu, Action::StopStreams, Action::DiscardRecording]);
        assert_eq!(m.phase(), Phase::Idle);
    }

    #[test]
    fn a_fault_while_running_keeps_what_was_recorded() {
        let mut m = ready();
        m.step(Event::Trigger, Duration::ZERO);
        let actions = m.step(Event::Failed(fault()), Duration::ZERO);
        assert_eq!(actions, [Action::StopTrain, Action::Drain { emitted: None }]);
        let actions = m.step(Event::Drained, Duration::ZERO);
        assert!(actions.contains(&Action::CloseRecording { aborted: Some("unplugged".to_owned()) }));
    }

    #[test]
    fn a_node_that_cannot_stop_the_train_closes_although_frames_go_on() {
        let mut m = ready();
        m.step(Event::Trigger, Duration::from_secs(1));
        m.step(Event::Failed(fault()), Duration::from_secs(2));
        let end = Duration::from_secs(2) + DRAIN_TIMEOUT;
        assert_eq!(m.step(Event::Tick, end), []);
        let close = Action::CloseRecording { aborted: Some("unplugged".to_owned()) };
        let actions = m.step(Event::Tick, end + Duration::from_millis(1));
        assert_eq!(actions, [Action::StopStreams, Action::DisarmHsu, close]);
        // The recorder may have been about to report it.
        assert_eq!(m.step(Event::Drained, end + Duration::from_millis(2)), []);
    }

    /// One of which frames are held until Record.
    fn holding_request() -> SessionRequest {
        SessionRequest { triggers: 0, pre_triggers: 240, ..request() }
    }

    fn holding() -> Machine {
        let mut machine = machine();
        machine.step(Event::Prepare(holding_request()), Duration::ZERO);
        (0..5).for_each(|_| drop(machine.step(Event::StepDone, Duration::ZERO)));
        assert_eq!(machine.step(Event::Trigger, Duration::ZERO), []);
        assert_eq!(machine.phase(), Phase::Holding);
        machine
    }

    #[test]
    fn record_makes_a_session_of_what_is_held() {
        let mut m = holding();
        let keep = KeepRequest { session_id: 1, first: 60, pressed: 299 };
        assert_eq!(m.step(Event::Keep(keep), Duration::ZERO), [Action::Keep(keep)]);
        assert_eq!(m.step(Event::Keep(KeepRequest { first: 90, ..keep }), Duration::ZERO), [], "once");
        assert_eq!(m.step(Event::Stop, Duration::ZERO), [Action::StopTrain]);
        let done = Event::TrainDone { emitted: 400 };
        assert_eq!(m.step(done, Duration::ZERO), [Action::Drain { emitted: Some(400) }]);
    }

    #[test]
    fn without_record_nothing_is_left() {
        let undone = [Action::DisarmHsu, Action::StopStreams, Action::DiscardRecording];
        let late = HOLD_TIMEOUT + Duration::from_secs(1);
        for (event, now) in [
            (Event::Failed(fault()), Duration::ZERO),
            (Event::Abort("operator".to_owned()), Duration::ZERO),
            (Event::Tick, late),
        ] {
            let actions = holding().step(event, now);
            assert_eq!((&actions[0], &actions[1..4]), (&Action::StopTrain, &undone[..]));
        }
        let mut m = holding();
        assert_eq!(m.step(Event::Stop, Duration::ZERO), [Action::StopTrain]);
        let actions = m.step(Event::TrainDone { emitted: 700 }, Duration::ZERO);
        assert_eq!(actions[..3], undone);
        assert_eq!(m.phase(), Phase::Idle);
    }

    fn any_event() -> impl Strategy<Value = Event> {
        prop_oneof![
            Just(Event::Prepare(request())),
            Just(Event::Prepare(holding_request())),
            Just(Event::Keep(KeepRequest { session_id: 1, first: 3, pressed: 9 })),
            Just(Event::StepDone),
            Just(Event::StepDone),
            Just(Event::StepDone),
            Just(Event::Failed(fault())),
            Just(Event::LinkLost),
            Just(Event::LinkBack),
            Just(Event::Start),
            Just(Event::Trigger),
            Just(Event::Trigger),
            Just(Event::TrainDone { emitted: 3 }),
            Just(Event::Drained),
            Just(Event::Closed),
            Just(Event::Stop),
            Just(Event::Abort("operator".to_owned())),
            Just(Event::Tick),
        ]
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(500))]
        /// Whatever happens in whatever order: streams and recordings are acquired and given back in turn.
        #[test]
        fn everything_acquired_is_given_back_once(events in proptest::collection::vec(any_event(), 0..60)) {
            let mut m = machine();
            let (mut streams, mut recordings) = (0i32, 0i32);
            let mut acting: Option<Action> = None;
            for (i, event) in events.into_iter().enumerate() {
                // Only an action that is being carried out can report that it is done.
                let event = if event == Event::StepDone && acting.is_none() { Event::Tick } else { event };
                if event == Event::StepDone {
                    match acting.take() {
                        Some(Action::StartStreams) => streams += 1,
                        Some(Action::CreateRecording) => recordings += 1,
                        _ => {}
                    }
                }
                for action in m.step(event, Duration::from_millis(i as u64)) {
                    match action {
                        Action::StopStreams => streams -= 1,
                        Action::DiscardRecording | Action::CloseRecording { .. } => recordings -= 1,
                        Action::PrepareDevices | Action::CreateRecording | Action::StartStreams | Action::SilenceGate | Action::ArmHsu => acting = Some(action),
                        _ => {}
                    }
                }
                prop_assert!((0..=1).contains(&streams) && (0..=1).contains(&recordings));
                if m.phase() == Phase::Idle {
                    acting = None;
                    prop_assert_eq!((streams, recordings), (0, 0));
                }
            }
        }
    }
}
