// SPDX-License-Identifier: MIT OR Apache-2.0
//! Behaviour of the unit: two links, one session, exactly N triggers.

use hsu_firmware_proto::{
    Arm, EndReason, Fault, HISTORY, HeadTiming, Hello, HostToUnit, Identity, LinkId, MAX_MESSAGE,
    MAX_RECORDS, NodeName, Refusal, Request, SessionId, State, Status, Sync, Timing, TriggerFlags,
    TriggerRecord, Unit, UnitOutputs, UnitToHost,
};
use proptest::prelude::{any, prop, prop_assert, prop_assert_eq, prop_oneof, proptest};

pub(crate) const PERIOD: u64 = 8_333_333;
const SECOND: u64 = 1_000_000_000;
pub(crate) const SESSION: SessionId = SessionId([1; 16]);

#[derive(Default)]
pub(crate) struct Outputs {
    sent: Vec<(LinkId, UnitToHost)>,
    fired: Vec<TriggerRecord>,
    /// Levels of the session's output, each with how many triggers had been fired.
    pub(crate) output: Vec<(bool, usize)>,
    heads: usize,
    line_is_full: bool,
}

impl UnitOutputs for Outputs {
    fn send(&mut self, link: LinkId, message: &UnitToHost) -> bool {
        let mut bytes = [0; MAX_MESSAGE];
        let length = message.encode(&mut bytes);
        assert_eq!(UnitToHost::decode(&bytes[..length]), Ok(*message), "it fits, and a host can read it");
        if !self.line_is_full {
            self.sent.push((link, *message));
        }
        !self.line_is_full
    }

    fn fire(&mut self, trigger: &TriggerRecord, heads: &[HeadTiming]) {
        self.fired.push(*trigger);
        self.heads = heads.len();
    }

    fn session_output(&mut self, high: bool) {
        self.output.push((high, self.fired.len()));
    }
}

/// A unit and its two hosts.
pub(crate) struct Bench {
    pub(crate) unit: Unit,
    pub(crate) out: Outputs,
    pub(crate) now: u64,
    next_beat: u64,
    id: u32,
}

fn timing(sync: Sync) -> Timing {
    let heads = [HeadTiming { delay_ns: 200_000, exposure_ns: 1_000_000 }; 4];
    Timing::new(PERIOD, sync, 2 * SECOND, &heads).expect("valid")
}

fn arm_of(session: SessionId, trigger_count: u64, warm_up: u32) -> Arm {
    let name = |text| NodeName::new(text).expect("short");
    let timing_digest = timing(Sync::Timer).digest();
    Arm { session, trigger_count, warm_up, timing_digest, expected: [name("a"), name("b")] }
}

impl Bench {
    fn new() -> Self {
        let identity =
            Identity { name: NodeName::new("test").expect("short"), unique_id: [0; 16], firmware: [0, 0, 1] };
        Self { unit: Unit::new(identity), out: Outputs::default(), now: SECOND, next_beat: 2 * SECOND, id: 0 }
    }

    /// Both have greeted and configured the same timing.
    pub(crate) fn ready() -> Self {
        let mut bench = Self::new();
        for (link, role) in [(LinkId::A, "a"), (LinkId::B, "b")] {
            bench.hello(link, role);
            bench.ask(link, Request::Configure(Ok(timing(Sync::Timer))));
        }
        bench
    }

    pub(crate) fn armed(trigger_count: u64, warm_up: u32) -> Self {
        let mut bench = Self::ready();
        for link in LinkId::ALL {
            bench.ack(link, Request::Arm(arm_of(SESSION, trigger_count, warm_up)));
        }
        bench
    }

    pub(crate) fn running(trigger_count: u64, warm_up: u32) -> Self {
        let mut bench = Self::armed(trigger_count, warm_up);
        bench.ack(LinkId::A, Request::Start(SESSION));
        bench
    }

    fn hello(&mut self, link: LinkId, role: &str) -> UnitToHost {
        let role = NodeName::new(role).expect("short");
        self.ask(link, Request::Hello(Hello { min: 1, current: 1, role }))
    }

    pub(crate) fn ask(&mut self, link: LinkId, request: Request) -> UnitToHost {
        self.id += 1;
        self.ask_as(link, self.id, request)
    }

    /// The answer to a request; everything else that it causes stays in `out`.
    fn ask_as(&mut self, link: LinkId, request_id: u32, request: Request) -> UnitToHost {
        let mut bytes = [0; MAX_MESSAGE];
        let length = HostToUnit { request_id, request }.encode(&mut bytes);
        let before = self.out.sent.len();
        self.unit.receive(link, self.now, &bytes[..length], &mut self.out);
        let (to, answer) = self.out.sent[before];
        assert_eq!((to, answer.request_id()), (link, Some(request_id)), "the answer comes first");
        self.out.sent.remove(before);
        let answers = self.out.sent[before..].iter().filter(|(_, m)| m.request_id().is_some()).count();
        assert_eq!(answers, 0, "one answer");
        answer
    }

    #[track_caller]
    pub(crate) fn ack(&mut self, link: LinkId, request: Request) {
        let answer = self.ask(link, request);
        assert!(matches!(answer, UnitToHost::Ack(_)), "{answer:?}");
    }

    #[track_caller]
    pub(crate) fn refusal(&mut self, link: LinkId, request: Request) -> Refusal {
        match self.ask(link, request) {
            UnitToHost::Refused(_, refusal) => refusal,
            other => panic!("expected a refusal, found {other:?}"),
        }
    }

    /// Both hosts are alive, and time passes in these steps.
    pub(crate) fn pass(&mut self, step: u64, steps: usize) {
        for _ in 0..steps {
            self.now += step;
            self.unit.tick(self.now, &mut self.out);
            if self.now >= self.next_beat {
                self.next_beat = self.now + SECOND / 2;
                for link in LinkId::ALL {
                    self.ask(link, Request::Heartbeat);
                }
            }
        }
    }

    fn told(&self, link: LinkId) -> Vec<UnitToHost> {
        self.out.sent.iter().filter(|(to, _)| *to == link).map(|(_, message)| *message).collect()
    }

    fn dones(&self, link: LinkId) -> Vec<(u64, EndReason)> {
        let done = |message| match message {
            UnitToHost::Done { session: SESSION, emitted, reason } => Some((emitted, reason)),
            _ => None,
        };
        self.told(link).into_iter().filter_map(done).collect()
    }

    fn faults(&self, link: LinkId) -> Vec<Fault> {
        let fault = |message| match message {
            UnitToHost::Fault(_, fault) => Some(fault),
            _ => None,
        };
        self.told(link).into_iter().filter_map(fault).collect()
    }

    fn status(&mut self, link: LinkId) -> Status {
        match self.ask(link, Request::ReadStatus) {
            UnitToHost::Status(_, status) => status,
            other => panic!("expected the status, found {other:?}"),
        }
    }

    pub(crate) fn numbers(&self) -> Vec<i64> {
        self.out.fired.iter().map(|record| record.number).collect()
    }
}

proptest! {
    /// However irregularly the unit gets to run: exactly the warm-up and N triggers, numbered without a gap, never
    /// closer than 7/8 of a period, told to both links in the same words, and one end behind them.
    #[test]
    fn exactly_n_triggers(
        count in 1u64..60,
        warm_up in 0u32..10,
        steps in prop::collection::vec(
            prop_oneof![1u64..10_000, 1u64..PERIOD, PERIOD..5 * PERIOD], 1..20),
    ) {
        let mut bench = Bench::running(count, warm_up);
        let mut turns = 0;
        for &step in steps.iter().cycle() {
            // Idle turns up to the next event do nothing; skip most of them, or short steps never arrive.
            bench.now = bench.now.max(bench.unit.next_due().saturating_sub(5 * step.min(PERIOD / 16)));
            bench.pass(step, 1);
            turns += 1;
            if bench.unit.state() == State::Finished || turns > 100_000 {
                break;
            }
        }
        bench.pass(PERIOD, 10);
        let expected: Vec<i64> = (-i64::from(warm_up)..count as i64).collect();
        prop_assert_eq!(bench.numbers(), expected);
        for pair in bench.out.fired.windows(2) {
            prop_assert!(pair[1].time_ns - pair[0].time_ns >= PERIOD - PERIOD / 8);
        }
        for record in &bench.out.fired {
            prop_assert_eq!(record.flags.contains(TriggerFlags::WARM_UP), record.number < 0);
            prop_assert_eq!(record.flags.contains(TriggerFlags::LAST), record.number + 1 == count as i64);
        }
        for link in LinkId::ALL {
            let told = bench.told(link);
            let triggers: Vec<TriggerRecord> = told.iter().filter_map(|message| match message {
                UnitToHost::Trigger(SESSION, record) => Some(*record),
                _ => None,
            }).collect();
            prop_assert_eq!(&triggers, &bench.out.fired);
            prop_assert_eq!(bench.dones(link), vec![(count, EndReason::Completed)]);
            let is_done = |m: &UnitToHost| matches!(m, UnitToHost::Done { .. });
            let is_trigger = |m: &UnitToHost| matches!(m, UnitToHost::Trigger(..));
            prop_assert!(told.iter().position(is_done) > told.iter().rposition(is_trigger));
        }
        prop_assert_eq!(bench.out.heads, 4);
    }

    /// Any requests in any order on any link: no panic, an answer to each, and nothing is fired unless both nodes
    /// had armed the same and one of them started it.
    #[test]
    fn nothing_fires_without_two_arms_and_a_start(
        moves in prop::collection::vec((any::<bool>(), 0usize..9, 0u8..3, 0u64..SECOND), 1..60),
    ) {
        let mut bench = Bench::ready();
        let mut arms: [Option<Arm>; 2] = [None, None];
        for (on_b, what, which, pause) in moves {
            let link = if on_b { LinkId::B } else { LinkId::A };
            let session = SessionId([which; 16]);
            let arm = arm_of(session, u64::from(which) + 3, 1);
            let request = match what {
                0..=2 => Request::Arm(arm),
                3 | 4 => Request::Start(session),
                5 => Request::Stop(session),
                6 => Request::Disarm(session),
                7 => Request::Goodbye,
                _ => Request::Hello(Hello {
                    min: 1, current: 1, role: NodeName::new(if on_b { "b" } else { "a" }).expect("short"),
                }),
            };
            let answer = bench.ask(link, request);
            let armed = &mut arms[link.index()];
            match (request, answer) {
                (Request::Arm(arm), UnitToHost::Ack(_)) => *armed = Some(arm),
                // While it runs the arming is spent anyway.
                (Request::Hello(_) | Request::Goodbye, _) if bench.unit.state() != State::Running => *armed = None,
                (Request::Start(session), UnitToHost::Ack(_)) => {
                    prop_assert!(arms.iter().all(|arm| arm.is_some_and(|a| a.session == session)), "{:?}", arms);
                    prop_assert_eq!(arms[0], arms[1]);
                }
                _ => {}
            }
            let fired = bench.out.fired.len();
            let may_fire = bench.unit.state() == State::Running;
            bench.pass(pause.max(1), 1);
            prop_assert!(may_fire || bench.out.fired.len() == fired);
            if matches!(bench.unit.state(), State::Idle | State::Finished) {
                arms = [None, None];
            }
        }
    }

    /// Bytes that are no request never panic the unit, and are answered whenever they carry a request id.
    #[test]
    fn garbage_is_refused(bytes in prop::collection::vec(any::<u8>(), 0..MAX_MESSAGE)) {
        let mut bench = Bench::ready();
        let before = bench.out.sent.len();
        bench.unit.receive(LinkId::A, bench.now, &bytes, &mut bench.out);
        prop_assert_eq!(bench.out.sent.len() > before, bytes.len() >= 6);
    }
}

#[test]
fn start_is_refused_unless_all_are_armed() {
    let mut bench = Bench::ready();
    let arm = arm_of(SESSION, 10, 0);
    assert!(matches!(bench.refusal(LinkId::A, Request::Start(SESSION)), Refusal::NotAllArmed { .. }));
    bench.ack(LinkId::B, Request::Arm(arm));
    assert_eq!(bench.unit.state(), State::Arming);
    let refusal = Refusal::NotAllArmed { armed_links: 0b10, expected: 2 };
    assert_eq!(bench.refusal(LinkId::A, Request::Start(SESSION)), refusal);
    let other = arm_of(SessionId([2; 16]), 10, 0);
    assert!(matches!(bench.refusal(LinkId::A, Request::Arm(other)), Refusal::SessionDiffers { .. }));
    for contradiction in [arm_of(SESSION, 11, 0), arm_of(SESSION, 10, 1)] {
        assert!(matches!(bench.refusal(LinkId::A, Request::Arm(contradiction)), Refusal::ArmDiffers { .. }));
    }
    bench.ack(LinkId::A, Request::Arm(arm));
    assert_eq!(bench.unit.state(), State::Armed);
    bench.ack(LinkId::B, Request::Start(SESSION));
    bench.ack(LinkId::A, Request::Start(SESSION));
    assert_eq!(bench.refusal(LinkId::A, Request::Arm(arm)), Refusal::Busy(State::Running));
}

#[test]
fn a_request_is_carried_out_once_however_often_it_comes() {
    let mut bench = Bench::ready();
    let first = bench.ask_as(LinkId::A, 77, Request::ReadClock { token: 1 });
    bench.now += 1000;
    assert_eq!(
        bench.ask_as(LinkId::A, 77, Request::ReadClock { token: 1 }),
        first,
        "the old answer, word for word"
    );
    assert_ne!(bench.ask_as(LinkId::A, 78, Request::ReadClock { token: 1 }), first);
    assert_ne!(bench.ask_as(LinkId::B, 78, Request::ReadClock { token: 9 }), first, "links do not share ids");
    for link in LinkId::ALL {
        bench.ack(link, Request::Arm(arm_of(SESSION, 1, 0)));
    }
    bench.ask_as(LinkId::A, 90, Request::Start(SESSION));
    bench.pass(PERIOD, 5);
    let again = bench.ask_as(LinkId::A, 90, Request::Start(SESSION));
    assert_eq!(again, UnitToHost::Ack(90), "a late repetition is acknowledged, not refused");
    bench.pass(PERIOD, 5);
    assert_eq!(bench.numbers(), [0]);
}

#[test]
fn a_session_is_fired_once() {
    let mut bench = Bench::running(3, 0);
    bench.pass(PERIOD, 10);
    let refusal = bench.refusal(LinkId::A, Request::Arm(arm_of(SESSION, 3, 0)));
    assert_eq!(refusal, Refusal::SessionSpent { emitted: 3 });
    bench.ack(LinkId::A, Request::Arm(arm_of(SessionId([9; 16]), 3, 0)));
}

#[test]
fn stop_ends_after_the_current_trigger_and_says_so_when_its_edges_are_out() {
    let mut bench = Bench::running(0, 2);
    bench.pass(PERIOD, 8);
    assert_eq!(bench.numbers(), (-2..6).collect::<Vec<_>>());
    bench.ack(LinkId::B, Request::Stop(SESSION));
    bench.ack(LinkId::A, Request::Stop(SESSION));
    bench.unit.tick(bench.now + 1_199_999, &mut bench.out);
    assert!(bench.dones(LinkId::A).is_empty(), "the last exposure ends 1.2 ms after its trigger");
    bench.now += 1_200_000;
    bench.unit.tick(bench.now, &mut bench.out);
    for link in LinkId::ALL {
        assert_eq!(bench.dones(link), [(6, EndReason::Stopped)]);
    }
    bench.pass(PERIOD, 20);
    assert_eq!(bench.out.fired.len(), 8);
    bench.ack(LinkId::A, Request::Stop(SESSION));
}

#[test]
fn disarm_ends_everything_at_once_for_both() {
    let mut bench = Bench::armed(100, 0);
    let stale = bench.refusal(LinkId::A, Request::Disarm(SessionId([5; 16])));
    assert!(matches!(stale, Refusal::SessionDiffers { .. }), "a late disarm of another session does no harm");
    bench.ack(LinkId::A, Request::Disarm(SessionId::NONE));
    assert_eq!(bench.dones(LinkId::B), [(0, EndReason::Aborted)]);
    bench = Bench::running(100, 0);
    bench.pass(PERIOD, 4);
    bench.ack(LinkId::B, Request::Disarm(SESSION));
    assert_eq!(bench.dones(LinkId::A), [(4, EndReason::Aborted)]);
    bench.pass(PERIOD, 20);
    assert_eq!(bench.out.fired.len(), 4);
}

#[test]
fn a_silent_host_disarms_before_the_start() {
    let mut bench = Bench::armed(100, 0);
    for _ in 0..12 {
        bench.now += SECOND / 4;
        bench.unit.tick(bench.now, &mut bench.out);
        bench.ask(LinkId::A, Request::Heartbeat);
    }
    assert_eq!(bench.faults(LinkId::A), [Fault::LinkSilent { link: LinkId::B }]);
    assert_eq!(bench.dones(LinkId::A), [(0, EndReason::LinkSilent)]);
    assert_eq!(bench.status(LinkId::A).heard_links, 0b01);
    assert_eq!(bench.out.fired.len(), 0);
}

#[test]
fn a_train_survives_a_silent_host_but_not_two_unless_it_is_counted() {
    for (count, end) in [(1000, EndReason::Completed), (0, EndReason::LinkSilent)] {
        let mut bench = Bench::running(count, 0);
        let mut turns = 0;
        while bench.unit.state() == State::Running && turns < 5000 {
            turns += 1;
            bench.now += PERIOD;
            bench.unit.tick(bench.now, &mut bench.out);
            // B dies at once, A after four seconds.
            if bench.now < 5 * SECOND {
                bench.ask(LinkId::A, Request::Heartbeat);
                assert_eq!(bench.unit.state(), State::Running);
            }
        }
        assert_eq!(bench.faults(LinkId::A)[0], Fault::LinkSilent { link: LinkId::B });
        assert_eq!(bench.dones(LinkId::A).last().map(|done| done.1), Some(end));
        let to_b = bench.told(LinkId::B).iter().filter(|m| matches!(m, UnitToHost::Trigger(..))).count();
        assert!(to_b < 300, "a dead link is not fed: {to_b} triggers");
    }
}

#[test]
fn a_host_that_greets_anew_withdraws_its_arming_but_not_a_train() {
    let mut bench = Bench::armed(20, 0);
    bench.hello(LinkId::A, "a");
    assert_eq!(bench.unit.state(), State::Arming);
    assert_eq!(bench.faults(LinkId::B), [Fault::ArmWithdrawn { link: LinkId::A }]);
    assert!(matches!(bench.refusal(LinkId::B, Request::Start(SESSION)), Refusal::NotAllArmed { .. }));
    let mut bench = Bench::running(20, 0);
    bench.pass(PERIOD, 3);
    bench.hello(LinkId::A, "a");
    bench.pass(PERIOD, 30);
    assert_eq!(bench.dones(LinkId::A), [(20, EndReason::Completed)]);
}

#[test]
fn history_answers_what_it_still_has() {
    let count = HISTORY as u64 + 100;
    let mut bench = Bench::running(count, 3);
    bench.pass(PERIOD, count as usize + 10);
    let mut query = |first, count| match bench
        .ask(LinkId::B, Request::QueryTriggers { session: SESSION, first, count })
    {
        UnitToHost::Triggers(_, SESSION, records) => records.as_slice().to_vec(),
        other => panic!("expected triggers, found {other:?}"),
    };
    assert_eq!(query(-3, 12), [], "overwritten");
    assert_eq!(query(95, 10).iter().map(|r| r.number).collect::<Vec<_>>(), (100..105).collect::<Vec<_>>());
    assert_eq!(query(200, u16::MAX).len(), MAX_RECORDS);
    assert_eq!(query(i64::MAX, u16::MAX), []);
    assert_eq!(query(i64::MIN, u16::MAX), []);
    let last = query(count as i64 - 1, 5);
    assert_eq!(last, bench.out.fired[bench.out.fired.len() - 1..]);
    let other = Request::QueryTriggers { session: SessionId([8; 16]), first: 0, count: 1 };
    assert!(matches!(bench.refusal(LinkId::A, other), Refusal::SessionDiffers { .. }));
}

#[test]
fn versions_that_do_not_meet_are_refused_with_both_numbers() {
    let mut bench = Bench::new();
    let role = NodeName::new("a").expect("short");
    assert_eq!(bench.refusal(LinkId::A, Request::ReadStatus), Refusal::HelloFirst);
    let refusal = bench.refusal(LinkId::A, Request::Hello(Hello { min: 9, current: 12, role }));
    assert_eq!(refusal, Refusal::Version { min: 1, current: 1 });
    // A Hello written in a version of the future is still read; other requests are refused by version.
    for (kind, fields, welcome) in [(0u8, vec![1, 7, b'a'], true), (10, vec![], false)] {
        let mut bytes = vec![7, kind, 1, 0, 0, 0];
        bytes.extend(fields);
        bytes.resize(if welcome { 6 + 18 } else { 6 }, 0);
        bench.out.sent.clear();
        bench.unit.receive(LinkId::A, bench.now, &bytes, &mut bench.out);
        let answer = bench.out.sent[0].1;
        match answer {
            UnitToHost::Welcome(1, hello) => assert!(welcome && hello.agreed == 1),
            UnitToHost::Refused(1, Refusal::Version { min: 1, current: 1 }) => assert!(!welcome),
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn timing_cannot_change_under_an_armed_link() {
    let mut bench = Bench::ready();
    let other = timing(Sync::ProjectorFrame);
    let stale = Arm { timing_digest: other.digest(), ..arm_of(SESSION, 5, 0) };
    assert!(matches!(bench.refusal(LinkId::A, Request::Arm(stale)), Refusal::TimingDiffers { .. }));
    bench.ack(LinkId::A, Request::Arm(arm_of(SESSION, 5, 0)));
    assert_eq!(bench.refusal(LinkId::B, Request::Configure(Ok(other))), Refusal::Busy(State::Arming));
    let same = timing(Sync::Timer);
    assert!(
        matches!(bench.ask(LinkId::B, Request::Configure(Ok(same))), UnitToHost::Timing(_, t) if t == same)
    );
}

#[test]
fn frame_sync_of_the_projectors_fires_and_its_absence_is_told_once() {
    let mut bench = Bench::ready();
    bench.ask(LinkId::A, Request::Configure(Ok(timing(Sync::ProjectorFrame))));
    let arm = Arm { timing_digest: timing(Sync::ProjectorFrame).digest(), ..arm_of(SESSION, 5, 0) };
    bench.unit.frame_sync(bench.now, &mut bench.out);
    for link in LinkId::ALL {
        bench.ack(link, Request::Arm(arm));
    }
    bench.unit.frame_sync(bench.now, &mut bench.out);
    assert_eq!(bench.numbers(), [0i64; 0], "not started");
    bench.ack(LinkId::A, Request::Start(SESSION));
    for frame in 0..3 {
        bench.now += PERIOD;
        bench.unit.frame_sync(bench.now, &mut bench.out);
        bench.unit.frame_sync(bench.now + PERIOD / 2, &mut bench.out);
        bench.unit.tick(bench.now + PERIOD / 2, &mut bench.out);
        assert_eq!(bench.out.fired.len(), frame + 1, "an edge in between is a glitch");
    }
    bench.pass(PERIOD, 20);
    assert_eq!(bench.out.fired.len(), 3);
    assert!(matches!(bench.faults(LinkId::A)[..], [Fault::FrameSyncMissing { .. }]));
    for _ in 0..4 {
        bench.now += PERIOD;
        bench.unit.frame_sync(bench.now, &mut bench.out);
    }
    assert_eq!(bench.numbers(), [0, 1, 2, 3, 4]);
    assert!(bench.out.fired[3].flags.contains(TriggerFlags::LATE));
    bench.pass(PERIOD, 2);
    assert_eq!(bench.dones(LinkId::B), [(5, EndReason::Completed)]);
}

#[test]
fn lost_messages_and_broken_frames_are_counted() {
    let mut bench = Bench::running(10, 0);
    bench.out.line_is_full = true;
    for _ in 0..5 {
        bench.now += PERIOD;
        bench.unit.tick(bench.now, &mut bench.out);
    }
    bench.out.line_is_full = false;
    bench.unit.bad_frames(LinkId::B, 3);
    let status = bench.status(LinkId::B);
    assert_eq!((status.unsent, status.frames_bad), (5, 3));
    assert_eq!(bench.out.fired.len(), 5, "a stalled line does not hold triggers up");
    bench.unit.hardware_fault(0x17, bench.now, &mut bench.out);
    assert_eq!(bench.faults(LinkId::A), [Fault::Hardware { code: 0x17 }]);
    assert_eq!(bench.status(LinkId::A).faults, 1);
}

/// The memory of a small microcontroller (64 KiB) must hold the unit, its decoders and a stack.
#[test]
fn the_unit_fits_a_microcontroller() {
    assert!(size_of::<Unit>() <= 18 * 1024, "{} bytes", size_of::<Unit>());
    assert!(size_of::<hsu_firmware_proto::frame::Decoder>() <= 512);
}

#[test]
fn hosts_are_told_the_serial_number_that_was_read_after_power_up() {
    let mut bench = Bench::new();
    let name = NodeName::new("test").expect("short");
    let identity = Identity { name, unique_id: *b"e6605838834f2a31", firmware: [0, 2, 0] };
    bench.unit.identify(identity);
    let answer = bench.hello(LinkId::A, "a");
    assert!(matches!(answer, UnitToHost::Welcome(_, welcome) if welcome.identity == identity), "{answer:?}");
}

/// After a delay the next trigger comes earlier than a period, but not before this one's exposures are over.
#[test]
fn a_late_trigger_keeps_its_exposures_to_itself() {
    for (exposure_ns, apart_ns) in [(1_000_000, PERIOD - PERIOD / 8), (8_000_000, 8_202_000)] {
        let mut bench = Bench::new();
        let heads = [HeadTiming { delay_ns: 200_000, exposure_ns }; 4];
        let timing = Timing::new(PERIOD, Sync::Timer, 2 * SECOND, &heads).expect("valid");
        for (link, role) in [(LinkId::A, "a"), (LinkId::B, "b")] {
            bench.hello(link, role);
            bench.ask(link, Request::Configure(Ok(timing)));
            bench.ack(link, Request::Arm(Arm { timing_digest: timing.digest(), ..arm_of(SESSION, 10, 0) }));
        }
        bench.ack(LinkId::A, Request::Start(SESSION));
        bench.pass(1_000, 10_000);
        bench.now += 2 * PERIOD;
        bench.pass(1_000, 20_000);
        let times: Vec<u64> = bench.out.fired.iter().map(|record| record.time_ns).collect();
        let shortest = times.windows(2).map(|pair| pair[1] - pair[0]).min().expect("two triggers");
        assert!((apart_ns..apart_ns + 1_000).contains(&shortest), "{shortest} ns, expected {apart_ns}");
    }
}
