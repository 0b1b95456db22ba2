// SPDX-License-Identifier: MIT OR Apache-2.0
//! The unit in the process, with a socket for a camera: each trigger is one command, reported when its time has come.

use super::tally::request_id;
use super::{ActionSetup, ActionTally, PtpClock};
use crate::base::clock_fit::Exchange;
use crate::base::ids::{CameraId, NodeId};
use crate::base::time::monotonic_ns;
use crate::hsu::{ArmRequest, EndReason, HeadTiming, Hsu, HsuEvent, HsuTimeouts, HsuTiming, SessionId, Sync};
use crate::network::{ActionKeys, ActionStatus, GVCP_PORT, action};
use crate::record::ActionCounts;
use std::net::{Ipv4Addr, UdpSocket};
use std::time::{Duration, Instant};

const SESSION: SessionId = SessionId([3; 16]);
const PERIOD: Duration = Duration::from_millis(20);

fn setup(address: Ipv4Addr, ptp: Option<PtpClock>) -> ActionSetup {
    let cameras = vec![(CameraId("c".to_owned()), address)];
    ActionSetup {
        tally: ActionTally::new(&cameras),
        cameras,
        keys: ActionKeys { device: 1, group: 2, mask: 3 },
        ptp,
        lead: PERIOD / 2,
    }
}

/// Fires triggers; gives their numbers and times, and when each report arrived.
fn train(setup: &ActionSetup, triggers: u64) -> Vec<(i64, u64, u64)> {
    let role = NodeId("a".to_owned());
    let hsu = setup.connect(&role, &HsuTimeouts::default(), None).expect("a unit");
    fire(&hsu, role, triggers)
}

fn fire(hsu: &Hsu, role: NodeId, triggers: u64) -> Vec<(i64, u64, u64)> {
    let timing = HsuTiming {
        period_ns: PERIOD.as_nanos() as u64,
        sync: Sync::Timer,
        host_silence: Duration::from_secs(2),
        heads: vec![HeadTiming { delay_ns: 0, exposure_ns: 1_000_000 }],
    };
    hsu.configure(&timing).expect("a timing");
    let arm = ArmRequest { session: SESSION, triggers: Some(triggers), warm_up: 3, nodes: vec![role] };
    hsu.arm(&arm).expect("armed");
    hsu.start(SESSION).expect("started");
    let mut reports = Vec::new();
    loop {
        match hsu.events().recv_timeout(Duration::from_secs(20)).expect("an event") {
            HsuEvent::Trigger { trigger, .. } => {
                reports.push((trigger.number, trigger.time_ns, monotonic_ns(Instant::now())));
            }
            HsuEvent::Done { emitted, reason, .. } => {
                assert_eq!((emitted, reason), (triggers, EndReason::Completed));
                return reports;
            }
            _ => {}
        }
    }
}

fn camera(address: Ipv4Addr) -> UdpSocket {
    let socket = UdpSocket::bind((address, GVCP_PORT)).expect("its own address");
    socket.set_nonblocking(true).expect("a socket");
    socket
}

fn received(socket: &UdpSocket) -> Vec<Vec<u8>> {
    let mut buffer = [0; 64];
    std::iter::from_fn(|| socket.recv(&mut buffer).ok().map(|length| buffer[..length].to_vec())).collect()
}

#[test]
fn at_once_each_trigger_is_one_command_and_one_report() {
    let socket = camera(Ipv4Addr::new(127, 0, 136, 1));
    let setup = setup(Ipv4Addr::new(127, 0, 136, 1), None);
    let reports = train(&setup, 5);
    assert_eq!(reports.iter().map(|(number, ..)| *number).collect::<Vec<_>>(), (-3..5).collect::<Vec<_>>());
    let expected: Vec<Vec<u8>> = (-3..5).map(|n| action(request_id(n), setup.keys, None)).collect();
    assert_eq!(received(&socket), expected);
    let (_, tally) = setup.tally.counts().remove(0);
    assert_eq!((tally.sent, tally.acknowledged, tally.unanswered), (8, 0, 8), "no camera answered");
}

#[test]
fn scheduled_a_command_has_its_triggers_time_and_no_report_comes_before_it() {
    let socket = camera(Ipv4Addr::new(127, 0, 136, 2));
    let ptp = PtpClock::default();
    let setup = setup(Ipv4Addr::new(127, 0, 136, 2), Some(ptp.clone()));
    // A clock that is exactly a million seconds ahead.
    let ahead = 1_000_000_000_000_000;
    for _ in 0..2 {
        let now = monotonic_ns(Instant::now());
        ptp.read(&Exchange { host_send_ns: now, host_receive_ns: now + 2, device_ns: now + 1 + ahead });
        std::thread::sleep(Duration::from_millis(2));
    }
    let reports = train(&setup, 4);
    for (number, time_ns, arrived_ns) in &reports {
        assert!(arrived_ns >= time_ns, "trigger {number} was reported {} ns early", time_ns - arrived_ns);
    }
    let packets = received(&socket);
    assert_eq!(packets.len(), reports.len());
    for ((number, time_ns, _), packet) in reports.iter().zip(packets) {
        let at = packet.get(20..).and_then(|rest| rest.first_chunk()).map(|rest| u64::from_be_bytes(*rest));
        let at = at.expect("a time");
        assert_eq!(packet, action(request_id(*number), setup.keys, Some(at)));
        assert!(at.abs_diff(time_ns + ahead) < 100_000, "trigger {number} at {at}, its report has {time_ns}");
    }
}

#[test]
fn without_a_reading_of_the_clock_nothing_is_scheduled_and_that_is_counted() {
    let socket = camera(Ipv4Addr::new(127, 0, 136, 3));
    let setup = setup(Ipv4Addr::new(127, 0, 136, 3), Some(PtpClock::default()));
    train(&setup, 2);
    assert_eq!(received(&socket), Vec::<Vec<u8>>::new());
    assert_eq!(setup.tally.counts()[0].1.not_sent, 5);
}

#[test]
fn ids_count_the_triggers_and_are_never_0() {
    assert_eq!([-3, -1, 0, 1, 65533, 65534, 65535].map(request_id), [65533, 65535, 1, 2, 65534, 65535, 1]);
}

#[test]
fn answers_are_counted_once_and_what_came_late_is_named_with_its_trigger() {
    let address = Ipv4Addr::new(127, 0, 136, 4);
    let (id, tally) = (CameraId("c".to_owned()), setup(address, None).tally);
    let fire = |number: i64, at_ns: u64| {
        tally.fires(number, at_ns);
        tally.sent(0, number, true);
    };
    let answer = |number: i64, status: ActionStatus| {
        tally.answered(address, request_id(number), status);
        tally.answered(address, request_id(number), status);
    };
    fire(-1, 0);
    fire(0, 0);
    answer(-1, ActionStatus::Late);
    answer(0, ActionStatus::Taken);
    // Ids go round: these two have those of the two before.
    fire(65_534, 0);
    fire(65_535, 0);
    answer(65_535, ActionStatus::Late);
    let counts = ActionCounts { sent: 4, acknowledged: 1, late: 2, refused: 0, unanswered: 1, not_sent: 0 };
    assert_eq!(tally.counts(), [(id.clone(), counts)]);
    let named = |tally: &ActionTally| -> Vec<(u64, u64)> {
        tally.untimely().iter().map(|(_, row, _)| (row.first, row.last)).collect()
    };
    assert_eq!(named(&tally), [(65_535, 65_535)], "the other one was of the warm-up");
    tally.begin();
    assert_eq!(named(&tally), []);
    // PTP: what was not exposed when the last good status was requested, up to what is not when the next one comes.
    assert_eq!(tally.unexposed(), i64::MIN);
    tally.ptp(&id, "Slave", tally.unexposed());
    fire(4, 0);
    fire(5, u64::MAX);
    assert_eq!(tally.unexposed(), 5, "its time has not come");
    tally.ptp(&id, "Slave", tally.unexposed());
    fire(5, 0);
    fire(6, 0);
    tally.ptp(&id, "Faulty", tally.unexposed());
    fire(7, 0);
    tally.ptp(&id, "Slave", tally.unexposed());
    assert_eq!(named(&tally), [(5, 7)]);
}
