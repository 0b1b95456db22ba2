// SPDX-License-Identifier: MIT OR Apache-2.0
//! The link over an in-memory line: the firmware's state machine at the other end, portions of any size, and
//! frames that get lost.

use super::HsuEvent;
use super::Refusal;
use super::error::HsuError;
use super::link::{HsuTimeouts, Link, Patience};
use super::unit::{Hsu, UnderWay};
use crate::base::ids::NodeId;
use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, unbounded};
use hsu_firmware_proto::frame::{self, Decoder};
use hsu_firmware_proto::{
    HeadTiming, Hello, HostToUnit, Identity, LinkId, MAX_MESSAGE, NodeName, Request, SessionId,
    TriggerRecord, TriggerRecords, Unit, UnitOutputs, UnitToHost, version,
};
use proptest::prelude::{ProptestConfig, any, prop, prop_assert, prop_assert_eq, proptest};
use std::io::{self, ErrorKind, Read, Write};
use std::thread::JoinHandle;
use std::time::Duration;

/// One direction of a line. Reading gives what one write took, in portions.
struct Receiving {
    bytes: Receiver<Vec<u8>>,
    rest: Vec<u8>,
    portions: Vec<usize>,
    reads: usize,
}

impl Read for Receiving {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.rest.is_empty() {
            match self.bytes.recv_timeout(Duration::from_millis(2)) {
                Ok(bytes) => self.rest = bytes,
                Err(RecvTimeoutError::Timeout) => return Err(ErrorKind::TimedOut.into()),
                Err(RecvTimeoutError::Disconnected) => return Ok(0),
            }
        }
        let portion = self.portions[self.reads % self.portions.len()];
        self.reads += 1;
        let length = portion.min(self.rest.len()).min(buffer.len());
        buffer[..length].copy_from_slice(&self.rest[..length]);
        self.rest.drain(..length);
        Ok(length)
    }
}

struct Sending(Sender<Vec<u8>>);

impl Write for Sending {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.send(bytes.to_vec()).map_err(|_| ErrorKind::BrokenPipe)?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn framed(message: &UnitToHost) -> Vec<u8> {
    let (mut bytes, mut out) = ([0; MAX_MESSAGE], [0; frame::MAX_FRAME]);
    let length = message.encode(&mut bytes);
    let length = frame::encode(&bytes[..length], &mut out);
    out[..length].to_vec()
}

struct Answers(Vec<UnitToHost>);

impl UnitOutputs for Answers {
    fn send(&mut self, _: LinkId, message: &UnitToHost) -> bool {
        self.0.push(*message);
        true
    }

    fn fire(&mut self, _: &TriggerRecord, _: &[HeadTiming]) {}

    fn session_output(&mut self, _: bool) {}
}

/// What the far end does with each request that reaches it; `None`: its answer gets lost.
fn far_end(
    portions: Vec<usize>,
    mut answer: impl FnMut(&[u8]) -> Vec<UnitToHost> + Send + 'static,
) -> (Receiving, Sending, JoinHandle<()>) {
    let (to_unit, from_host) = unbounded::<Vec<u8>>();
    let (to_host, from_unit) = unbounded();
    let thread = std::thread::spawn(move || {
        let mut decoder = Decoder::new();
        for bytes in from_host {
            let mut answers = Vec::new();
            decoder.feed(&bytes, |message| answers.extend(answer(message)));
            if answers.iter().any(|message| to_host.send(framed(message)).is_err()) {
                return;
            }
        }
    });
    (Receiving { bytes: from_unit, rest: Vec::new(), portions, reads: 0 }, Sending(to_unit), thread)
}

fn unit() -> Unit {
    let identity = Identity {
        name: NodeName::new("fourdbody-hsu").expect("short"),
        unique_id: [7; 16],
        firmware: [1, 0, 0],
    };
    Unit::new(identity)
}

const HELLO: Request = Request::Hello(Hello {
    min: version::MIN,
    current: version::CURRENT,
    role: NodeName([b'a', 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]),
});

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]

    /// Requests and answers get lost, bytes come in any portions: each request is answered with its own
    /// answer, and a repeated one with the first answer, word for word.
    #[test]
    fn requests_are_repeated_until_answered(
        portions in prop::collection::vec(1usize..40, 1..8),
        lost in prop::collection::vec(any::<bool>(), 1..12),
    ) {
        let (mut unit, mut now, mut turn) = (unit(), 0u64, 0usize);
        let (reader, writer, far) = far_end(portions, move |message| {
            now += 1000;
            turn += 1;
            // Every third message gets through whatever the pattern, so that patience suffices.
            let lose = |what: usize| turn % 3 != 0 && lost[(turn + what) % lost.len()];
            if lose(0) {
                return Vec::new();
            }
            let mut answers = Answers(Vec::new());
            unit.receive(LinkId::A, now, message, &mut answers);
            if lose(1) { Vec::new() } else { answers.0 }
        });
        let link = Link::start("a test line", reader, writer, |_| {}).expect("a thread");
        let patience = Patience { answer: Duration::from_millis(10), attempts: 200 };
        let welcome = link.ask("the greeting", HELLO, patience).expect("an answer");
        prop_assert!(matches!(welcome.message, UnitToHost::Welcome(..)));
        let mut before = 0;
        for token in 0..10 {
            let answer = link.ask("the time", Request::ReadClock { token }, patience).expect("an answer");
            let UnitToHost::Clock { token: back, time_ns, .. } = answer.message else {
                panic!("expected the time, found {:?}", answer.message)
            };
            prop_assert_eq!(back, token);
            prop_assert!(time_ns > before, "the time of the first receipt, and each request has its own");
            prop_assert!(answer.received >= answer.sent);
            before = time_ns;
        }
        drop(link);
        far.join().expect("the far end ends with the line");
    }
}

#[test]
fn a_device_that_echoes_does_not_answer() {
    let (to_itself, from_itself) = unbounded();
    let reader = Receiving { bytes: from_itself, rest: Vec::new(), portions: vec![100], reads: 0 };
    let link = Link::start("a test line", reader, Sending(to_itself), |_| {}).expect("a thread");
    let patience = Patience { answer: Duration::from_millis(20), attempts: 3 };
    let error = link.ask("the greeting", HELLO, patience).expect_err("an echo is no answer");
    assert!(matches!(error, HsuError::NoAnswer { attempts: 3, .. }));
    assert!(link.bad_frames() > 0, "it is noticed, though");
}

/// A keeper that the host kept from running for seconds, and that finds another request under way, has not been left
/// without an answer.
#[test]
fn silence_counts_from_the_first_request_without_an_answer() {
    let mut unit = unit();
    let (reader, writer, _far) = far_end(vec![100], move |message| {
        let mut answers = Answers(Vec::new());
        unit.receive(LinkId::A, 1, message, &mut answers);
        answers.0
    });
    let link = Link::start("a test line", reader, writer, |_| {}).expect("a thread");
    let patience = Patience { answer: Duration::from_millis(20), attempts: 500 };
    link.ask("the greeting", HELLO, patience).expect("an answer");
    std::thread::sleep(Duration::from_millis(30));
    assert_eq!(link.unanswered_for(), Duration::ZERO, "nothing was asked");

    let (_sender, nothing) = unbounded();
    let (to_nobody, _receiver) = unbounded();
    let reader = Receiving { bytes: nothing, rest: Vec::new(), portions: vec![1], reads: 0 };
    let link = Link::start("a test line", reader, Sending(to_nobody), |_| {}).expect("a thread");
    let patience = Patience { answer: Duration::from_millis(10), attempts: 3 };
    link.ask("the greeting", HELLO, patience).expect_err("nobody is there");
    assert!(link.unanswered_for() >= Duration::from_millis(30), "since the first attempt");
}

#[test]
fn a_broken_line_is_reported_at_once() {
    let (_, nothing) = unbounded();
    let (to_nobody, _) = unbounded();
    let reader = Receiving { bytes: nothing, rest: Vec::new(), portions: vec![1], reads: 0 };
    let link = Link::start("a test line", reader, Sending(to_nobody), |_| {}).expect("a thread");
    let patience = Patience { answer: Duration::from_secs(3600), attempts: 1 };
    assert!(matches!(link.ask("the greeting", HELLO, patience), Err(HsuError::Io { .. })));
}

fn connect(answer: impl FnMut(&[u8]) -> Vec<UnitToHost> + Send + 'static) -> Result<Hsu, HsuError> {
    let (reader, writer, _) = far_end(vec![7], answer);
    Hsu::over(reader, writer, "a test line".into(), &NodeId::from("a"), &HsuTimeouts::default(), None)
}

/// The unit reports a trigger together with its greeting, before anybody else of the host has had a turn.
#[test]
fn triggers_before_a_new_connection_are_requested() {
    let (mut unit, mut greeted) = (unit(), false);
    let record = |number: i64| TriggerRecord {
        number,
        time_ns: 8_333_333 * number.unsigned_abs(),
        ..TriggerRecord::default()
    };
    let answer = move |message: &[u8]| {
        let request = HostToUnit::decode(message).expect("a request");
        let mut answers = Answers(Vec::new());
        match request.request {
            Request::QueryTriggers { session, first, count } => {
                let mut records = TriggerRecords::default();
                (first..first + i64::from(count)).take_while(|&i| records.push(record(i))).for_each(drop);
                answers.0.push(UnitToHost::Triggers(request.request_id, session, records));
            }
            _ => unit.receive(LinkId::A, 0, message, &mut answers),
        }
        if !std::mem::replace(&mut greeted, true) {
            answers.0.push(UnitToHost::Trigger(SessionId([9; 16]), record(14)));
        }
        answers.0
    };
    let (reader, writer, _) = far_end(vec![7], answer);
    let session = Some(UnderWay { session: SessionId([9; 16]), next: 11 });
    let role = NodeId::from("a");
    let hsu = Hsu::over(reader, writer, "a test line".into(), &role, &HsuTimeouts::default(), session);
    let hsu = hsu.expect("greeted");
    let next = || {
        loop {
            match hsu.events().recv_timeout(Duration::from_secs(30)).expect("an event") {
                HsuEvent::Trigger { trigger, .. } => return trigger.number,
                HsuEvent::TriggersMissing { .. } => panic!("nothing is missing"),
                _ => {}
            }
        }
    };
    assert_eq!([next(), next(), next(), next()], [11, 12, 13, 14]);
}

#[test]
fn a_unit_of_another_version_is_named_with_both_ranges() {
    let result = connect(|message| {
        let id = HostToUnit::decode(message).expect("a request").request_id;
        vec![UnitToHost::Refused(id, Refusal::Version { min: 7, current: 9 })]
    });
    let error = result.expect_err("no version in common");
    assert!(error.to_string().contains("7 to 9"), "{error}");
}

#[test]
fn another_product_is_refused_by_name() {
    let identity = Identity {
        name: NodeName::new("coffee-maker").expect("short"),
        unique_id: [0; 16],
        firmware: [1, 0, 0],
    };
    let mut unit = Unit::new(identity);
    let result = connect(move |message| {
        let mut answers = Answers(Vec::new());
        unit.receive(LinkId::A, 0, message, &mut answers);
        answers.0
    });
    let error = result.expect_err("not an HSU");
    assert!(error.to_string().contains("is a \"coffee-maker\", expected a \"fourdbody-hsu\""), "{error}");
}

#[test]
fn names_that_do_not_fit_the_wire_are_refused() {
    for role in ["", "a-node-with-a-name-of-33-characters"] {
        let (reader, writer, _) = far_end(vec![1], |_| Vec::new());
        let result = Hsu::over(
            reader,
            writer,
            "a test line".into(),
            &NodeId::from(role),
            &HsuTimeouts::default(),
            None,
        );
        let error = result.expect_err("no name for the wire").to_string();
        assert!(error.contains("expected 1 to 16 bytes"), "{error}");
    }
}
