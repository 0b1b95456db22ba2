// SPDX-License-Identifier: MIT OR Apache-2.0
//! Golden bytes of protocol version 1.
//!
//! If a test in this file fails, DO NOT CHANGE THE TEST: units in the field speak these bytes. Restore the
//! layout, or add a kind, or raise `version::CURRENT` and add a file for the new version.

use hsu_firmware_proto::{
    Arm, EndReason, Fault, HeadTiming, Hello, HostToUnit, Identity, LinkId, MAX_MESSAGE, NodeName, Refusal,
    Request, SessionId, State, Status, Sync, Timing, TimingError, TriggerFlags, TriggerRecord,
    TriggerRecords, UnitToHost, Welcome,
};

const ID: u32 = 0x0403_0201;
/// The request id on the wire.
const ID_BYTES: [u8; 4] = [0x01, 0x02, 0x03, 0x04];
const SESSION: SessionId = SessionId([
    0xa0, 0xa1, 0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xab, 0xac, 0xad, 0xae, 0xaf,
]);
/// "a", zero-padded to 16 bytes.
const NODE_A: [u8; 16] = [b'a', 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
const NODE_B: [u8; 16] = [b'b', 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];

#[track_caller]
fn host(request: Request, kind: u8, fields: &[&[u8]]) {
    let message = HostToUnit { request_id: ID, request };
    let mut expected = vec![1, kind]; // version, kind
    expected.extend(ID_BYTES);
    expected.extend(fields.concat());
    let mut bytes = [0; MAX_MESSAGE];
    let length = message.encode(&mut bytes);
    assert_eq!(bytes[..length], expected);
    assert_eq!(HostToUnit::decode(&expected), Ok(message));
}

#[track_caller]
fn unit(message: UnitToHost, kind: u8, fields: &[&[u8]]) {
    let mut expected = vec![1, kind]; // version, kind
    expected.extend(fields.concat());
    let mut bytes = [0; MAX_MESSAGE];
    let length = message.encode(&mut bytes);
    assert_eq!(bytes[..length], expected);
    assert_eq!(UnitToHost::decode(&expected), Ok(message));
}

fn timing() -> Timing {
    let heads = [
        HeadTiming { delay_ns: 200_000, exposure_ns: 1_000_000 },
        HeadTiming { delay_ns: 0, exposure_ns: 2_000_000 },
    ];
    Timing::new(8_333_333, Sync::ProjectorFrame, 2_000_000_000, &heads).expect("valid")
}

const TIMING_BYTES: [&[u8]; 9] = [
    &[0x15, 0x28, 0x7f, 0, 0, 0, 0, 0],    // period 8 333 333 ns = 0x7f2815
    &[1],                                  // sync: projector frame
    &[0x00, 0x94, 0x35, 0x77, 0, 0, 0, 0], // host silence 2 000 000 000 ns = 0x77359400
    &[2],                                  // heads
    &[0x40, 0x0d, 0x03, 0, 0, 0, 0, 0],    // head 0 delay 200 000 ns = 0x030d40
    &[0x40, 0x42, 0x0f, 0, 0, 0, 0, 0],    // head 0 exposure 1 000 000 ns = 0x0f4240
    &[0, 0, 0, 0, 0, 0, 0, 0],             // head 1 delay 0
    &[0x80, 0x84, 0x1e, 0, 0, 0, 0, 0],    // head 1 exposure 2 000 000 ns = 0x1e8480
    &[],
];

#[test]
fn hello() {
    let role = NodeName::new("a").expect("short");
    host(Request::Hello(Hello { min: 1, current: 3, role }), 0, &[&[1], &[3], &NODE_A]);
}

#[test]
fn configure() {
    host(Request::Configure(Ok(timing())), 1, &TIMING_BYTES);
}

#[test]
fn configure_with_a_timing_that_cannot_be_run_is_readable() {
    let mut bytes = vec![1, 1];
    bytes.extend(ID_BYTES);
    bytes.extend(TIMING_BYTES.concat());
    bytes[6 + 2] = 0; // period 0x2815 ns: 10 us
    let request = Request::Configure(Err(TimingError::Period));
    assert_eq!(HostToUnit::decode(&bytes), Ok(HostToUnit { request_id: ID, request }));
}

#[test]
fn requests_without_fields() {
    host(Request::ReadTiming, 2, &[]);
    host(Request::ReadStatus, 9, &[]);
    host(Request::Heartbeat, 10, &[]);
    host(Request::Goodbye, 11, &[]);
}

#[test]
fn arm() {
    let arm = Arm {
        session: SESSION,
        trigger_count: 0x0102,
        warm_up: 5,
        timing_digest: 0xdead_beef,
        expected: [NodeName::new("a").expect("short"), NodeName::new("b").expect("short")],
    };
    let fields: [&[u8]; 6] = [
        &SESSION.0,
        &[0x02, 0x01, 0, 0, 0, 0, 0, 0], // trigger count
        &[5, 0, 0, 0],                   // warm-up
        &[0xef, 0xbe, 0xad, 0xde],       // timing digest
        &NODE_A,
        &NODE_B,
    ];
    host(Request::Arm(arm), 3, &fields);
}

#[test]
fn requests_with_a_session() {
    host(Request::Start(SESSION), 4, &[&SESSION.0]);
    host(Request::Stop(SESSION), 5, &[&SESSION.0]);
    host(Request::Disarm(SESSION), 6, &[&SESSION.0]);
}

#[test]
fn read_clock() {
    host(Request::ReadClock { token: 0x0807_0605_0403_0201 }, 7, &[&[1, 2, 3, 4, 5, 6, 7, 8]]);
}

#[test]
fn query_triggers() {
    let request = Request::QueryTriggers { session: SESSION, first: -2, count: 12 };
    let fields: [&[u8]; 3] = [
        &SESSION.0,
        &[0xfe, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff], // first: -2
        &[12, 0],                                          // count
    ];
    host(request, 8, &fields);
}

#[test]
fn welcome() {
    let identity = Identity {
        name: NodeName::new("fourdbody-hsu").expect("short"),
        unique_id: *b"HSU-2026-0000017",
        firmware: [1, 2, 0x0304],
    };
    let welcome = Welcome { identity, min: 1, current: 2, agreed: 1, link: LinkId::B };
    let fields: [&[u8]; 5] = [
        &ID_BYTES,
        b"fourdbody-hsu\0\0\0",
        b"HSU-2026-0000017",
        &[1, 0, 2, 0, 4, 3], // firmware 1.2.772
        &[1, 2, 1, 1],       // oldest, newest, agreed version; link B
    ];
    unit(UnitToHost::Welcome(ID, welcome), 0x80, &fields);
}

#[test]
fn ack() {
    unit(UnitToHost::Ack(ID), 0x81, &[&ID_BYTES]);
}

#[test]
fn refusals() {
    let cases = [
        (Refusal::Version { min: 1, current: 2 }, 0, 1, 2),
        (Refusal::HelloFirst, 1, 0, 0),
        (Refusal::UnknownRequest { kind: 77 }, 2, 77, 0),
        (Refusal::Malformed, 3, 0, 0),
        (Refusal::Timing(TimingError::Period), 4, 0, 0),
        (Refusal::Timing(TimingError::HeadCount), 4, 1, 0),
        (Refusal::Timing(TimingError::Head(3)), 4, 2, 3),
        (Refusal::Timing(TimingError::HostSilence), 4, 3, 0),
        (Refusal::NotConfigured, 5, 0, 0),
        (Refusal::Busy(State::Running), 6, 3, 0),
        (Refusal::TimingDiffers { unit: 7, host: 8 }, 7, 7, 8),
        (Refusal::SessionDiffers { unit: 9, host: 10 }, 8, 9, 10),
        (Refusal::ArmDiffers { unit: 100, host: 101 }, 9, 100, 101),
        (Refusal::RoleNotExpected, 10, 0, 0),
        (Refusal::SessionSpent { emitted: 120 }, 11, 120, 0),
        (Refusal::NotAllArmed { armed_links: 1, expected: 2 }, 12, 1, 2),
        (Refusal::NotRunning(State::Finished), 13, 4, 0),
        (Refusal::WarmUpTooLong { found: 20_000 }, 14, 20_000, 0),
        (Refusal::SessionMissing, 15, 0, 0),
        (Refusal::Other { code: 200 }, 200, 0, 0),
    ];
    for (refusal, code, a, b) in cases {
        let (a, b): (u64, u64) = (a, b);
        let fields: [&[u8]; 4] = [&ID_BYTES, &[code], &a.to_le_bytes(), &b.to_le_bytes()];
        unit(UnitToHost::Refused(ID, refusal), 0x82, &fields);
    }
}

#[test]
fn timing_echo() {
    unit(UnitToHost::Timing(ID, timing()), 0x83, &[&ID_BYTES, &TIMING_BYTES.concat()]);
}

/// Both hosts and the unit compute it on their own.
#[test]
fn timing_digest_is_the_crc_of_the_encoded_timing() {
    let crc = hsu_firmware_proto::frame::crc32(&TIMING_BYTES.concat());
    assert_eq!(timing().digest(), crc);
}

#[test]
fn clock() {
    let message = UnitToHost::Clock { request_id: ID, token: 5, time_ns: 0x0100 };
    unit(message, 0x84, &[&ID_BYTES, &[5, 0, 0, 0, 0, 0, 0, 0], &[0, 1, 0, 0, 0, 0, 0, 0]]);
}

const WARM_UP: TriggerRecord =
    TriggerRecord { number: -1, time_ns: 0x0203, flags: TriggerFlags(TriggerFlags::WARM_UP.0) };
const WARM_UP_BYTES: [&[u8]; 3] = [
    &[0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff], // number -1
    &[3, 2, 0, 0, 0, 0, 0, 0],                         // time
    &[1],                                              // flags: warm-up
];

#[test]
fn triggers() {
    let last = TriggerFlags::LAST.with_if(TriggerFlags::LATE, true);
    let mut records = TriggerRecords::default();
    assert!(records.push(WARM_UP));
    assert!(records.push(TriggerRecord { number: 0, time_ns: 0x0204, flags: last }));
    let fields: [&[u8]; 5] = [
        &ID_BYTES,
        &SESSION.0,
        &[2], // how many
        &WARM_UP_BYTES.concat(),
        &[0, 0, 0, 0, 0, 0, 0, 0, 4, 2, 0, 0, 0, 0, 0, 0, 0b110], // number 0, time, flags: last, late
    ];
    unit(UnitToHost::Triggers(ID, SESSION, records), 0x85, &fields);
}

#[test]
fn status_and_heartbeat() {
    let status = Status {
        state: State::Finished,
        session: SESSION,
        time_ns: 1,
        next_number: 120,
        emitted: 120,
        end: EndReason::Stopped,
        armed_links: 0b10,
        heard_links: 0b11,
        timing_digest: 2,
        late: 3,
        faults: 4,
        frames_bad: 5,
        unsent: 6,
    };
    let fields: [&[u8]; 9] = [
        &[4], // finished
        &SESSION.0,
        &[1, 0, 0, 0, 0, 0, 0, 0],             // time
        &[120, 0, 0, 0, 0, 0, 0, 0],           // next number
        &[120, 0, 0, 0, 0, 0, 0, 0],           // emitted
        &[2],                                  // stopped
        &[0b10, 0b11],                         // armed links, heard links
        &[2, 0, 0, 0, 3, 0, 0, 0],             // timing digest, late
        &[4, 0, 0, 0, 5, 0, 0, 0, 6, 0, 0, 0], // faults, bad frames, unsent
    ];
    unit(UnitToHost::Status(ID, status), 0x86, &[&ID_BYTES, &fields.concat()]);
    unit(UnitToHost::Heartbeat(status), 0x87, &fields);
}

#[test]
fn codes_of_states_and_ends() {
    let states = [State::Idle, State::Arming, State::Armed, State::Running, State::Finished];
    assert_eq!(states.map(|state| state as u8), [0, 1, 2, 3, 4]);
    let ends = [
        EndReason::None,
        EndReason::Completed,
        EndReason::Stopped,
        EndReason::Aborted,
        EndReason::LinkSilent,
    ];
    assert_eq!(ends.map(|end| end as u8), [0, 1, 2, 3, 4]);
    assert_eq!([Sync::Timer as u8, Sync::ProjectorFrame as u8], [0, 1]);
}

#[test]
fn trigger() {
    unit(UnitToHost::Trigger(SESSION, WARM_UP), 0x88, &[&SESSION.0, &WARM_UP_BYTES.concat()]);
}

#[test]
fn done() {
    let message = UnitToHost::Done { session: SESSION, emitted: 7, reason: EndReason::Completed };
    unit(message, 0x89, &[&SESSION.0, &[7, 0, 0, 0, 0, 0, 0, 0], &[1]]);
}

#[test]
fn faults() {
    let cases = [
        (Fault::LinkSilent { link: LinkId::B }, 0, 1),
        (Fault::ArmWithdrawn { link: LinkId::A }, 1, 0),
        (Fault::FrameSyncMissing { since_ns: 12_500_000 }, 2, 12_500_000),
        (Fault::Hardware { code: 0x1234 }, 3, 0x1234),
    ];
    for (fault, code, value) in cases {
        let value: u64 = value;
        unit(UnitToHost::Fault(SESSION, fault), 0x8a, &[&SESSION.0, &[code], &value.to_le_bytes()]);
    }
}

/// `0x00, COBS(message ++ CRC-32 little-endian), 0x00`, by hand: Ack with its id 1.
#[test]
fn frame() {
    let message = [1, 0x81, 1, 0, 0, 0];
    let crc = hsu_firmware_proto::frame::crc32(&message).to_le_bytes();
    assert!(crc.iter().all(|&byte| byte != 0), "the example is only good without zeros in the CRC");
    let mut framed = [0; hsu_firmware_proto::frame::MAX_FRAME];
    let length = hsu_firmware_proto::frame::encode(&message, &mut framed);
    // A code 4 run of three bytes, its zero; two empty runs and their zeros; the CRC.
    let expected = [0, 4, 1, 0x81, 1, 1, 1, 5, crc[0], crc[1], crc[2], crc[3], 0];
    assert_eq!(framed[..length], expected);
    // Python: zlib.crc32(bytes([1, 0x81, 1, 0, 0, 0]))
    assert_eq!(u32::from_le_bytes(crc), CRC_OF_ACK);
}

const CRC_OF_ACK: u32 = 0x4ea4_8c41;
