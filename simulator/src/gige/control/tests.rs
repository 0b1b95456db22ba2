// SPDX-License-Identifier: MIT OR Apache-2.0
//! Tests of the control channel: privileges, heartbeat, locks, and traffic of any kind.

use super::super::clock::{CameraClock, ClockOptions};
use super::super::habits::Habits;
use super::super::map::{Access, Id, REGISTERS};
use super::super::registers::Identity;
use super::*;
use proptest::prelude::*;
use std::net::Ipv4Addr;
use std::sync::Arc;

fn device() -> (Control, Instant) {
    let start = Instant::now();
    let clock = CameraClock::new(start, ClockOptions { offset_ns: 5, drift_ppm: 0.0 });
    let identity = Identity {
        address: Ipv4Addr::new(127, 0, 7, 11),
        model: "Model".into(),
        serial: "S1".into(),
        user_name: "left".into(),
    };
    (Control::new(Registers::new(identity, (1920, 1200), Arc::new(clock), Habits::default())), start)
}

fn host(port: u16) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::LOCALHOST, port)
}

struct Client<'a> {
    control: &'a mut Control,
    from: SocketAddrV4,
    now: Instant,
}

impl Client<'_> {
    fn send(&mut self, command: Command) -> (u16, Vec<u8>, Vec<Action>) {
        let request = Request { id: 77, ack: true, command };
        let outcome = self.control.handle(&request.encode(), self.from, self.now);
        let answer = outcome.answer.expect("an acknowledge was asked for");
        assert_eq!(answer[6..8], [0, 77], "the request id is echoed");
        (u16::from_be_bytes([answer[0], answer[1]]), answer[8..].to_vec(), outcome.actions)
    }

    fn write(&mut self, id: Id, value: u32) -> (u16, Vec<Action>) {
        let (status, _, actions) = self.send(Command::WriteRegisters(vec![(id.address(), value)]));
        (status, actions)
    }

    fn read(&mut self, id: Id) -> u32 {
        let (status, data, _) = self.send(Command::ReadRegisters(vec![id.address()]));
        assert_eq!(status, 0);
        u32::from_be_bytes(data.try_into().expect("four bytes"))
    }
}

const OK: u16 = Status::Success as u16;
const DENIED: u16 = Status::AccessDenied as u16;
const INVALID: u16 = Status::InvalidParameter as u16;

#[test]
fn only_the_controller_writes() {
    let (mut control, now) = device();
    let mut first = Client { control: &mut control, from: host(1000), now };
    assert_eq!(first.write(Id::Width, 640).0, DENIED, "nobody controls yet");
    assert_eq!(first.write(Id::Privilege, CONTROL).0, OK);
    assert_eq!(first.write(Id::Width, 640).0, OK);
    let mut second = Client { control: &mut control, from: host(1001), now };
    assert_eq!(second.write(Id::Privilege, CONTROL).0, DENIED);
    assert_eq!(second.write(Id::Width, 800).0, DENIED);
    assert_eq!(second.read(Id::Width), 640, "control access lets others read");
    assert_eq!(second.read(Id::Privilege), CONTROL);
    let holder = (second.read(Id::ControllerAddress), second.read(Id::ControllerPort));
    assert_eq!(holder, (Ipv4Addr::LOCALHOST.to_bits(), 1000));
    let mut first = Client { control: &mut control, from: host(1000), now };
    assert_eq!(first.write(Id::Privilege, EXCLUSIVE).0, OK);
    let mut second = Client { control: &mut control, from: host(1001), now };
    let read = second.send(Command::ReadRegisters(vec![Id::Width.address()]));
    assert_eq!(read.0, DENIED, "exclusive access does not");
    let mut first = Client { control: &mut control, from: host(1000), now };
    assert_eq!(first.write(Id::Privilege, 0), (OK, vec![Action::Stop]));
    let mut second = Client { control: &mut control, from: host(1001), now };
    assert_eq!(second.write(Id::Privilege, CONTROL).0, OK);
    assert_eq!(second.write(Id::Privilege, 4).0, INVALID, "switchover is not implemented");
}

#[test]
fn an_action_is_for_whoever_has_its_keys_and_a_controller() {
    let (mut control, now) = device();
    let action = ActionCommand { device_key: 1, group_key: 2, group_mask: 0b110, at_ns: None };
    let act = |control: &mut Control, action: ActionCommand| {
        let request = Request { id: 9, ack: true, command: Command::Action(action) };
        let outcome = control.handle(&request.encode(), host(2000), now);
        let status = outcome.answer.map(|answer| u16::from_be_bytes([answer[0], answer[1]]));
        (status, outcome.actions)
    };
    let keys = [(Id::ActionDeviceKey, 1), (Id::ActionGroupKey, 2), (Id::ActionGroupMask, 0b011)];
    let mut client = Client { control: &mut control, from: host(1000), now };
    assert_eq!(client.write(Id::Privilege, CONTROL).0, OK);
    keys.iter().for_each(|(id, key)| assert_eq!(client.write(*id, *key).0, OK));
    let done = |time| vec![Action::ActionTrigger { id: 9, time }];
    assert_eq!(act(&mut control, action), (Some(OK), done(now)));
    for other in [
        ActionCommand { device_key: 0, ..action },
        ActionCommand { group_key: 3, ..action },
        ActionCommand { group_mask: 0b100, ..action },
    ] {
        assert_eq!(act(&mut control, other), (None, vec![]), "{other:?} is not for this camera");
    }
    let scheduled = |at_ns| ActionCommand { at_ns: Some(at_ns), ..action };
    let no_time = Some(Status::NoReferenceTime as u16);
    assert_eq!(act(&mut control, scheduled(5)), (no_time, vec![]), "its clock is its own");
    let mut client = Client { control: &mut control, from: host(1000), now };
    assert_eq!(client.write(Id::PtpEnable, 1).0, OK);
    let common = |time: Instant| {
        let clock = CameraClock::new(time, ClockOptions::default());
        clock.set_common(true);
        clock.at(time)
    };
    let later = now + Duration::from_millis(5);
    assert_eq!(act(&mut control, scheduled(common(later))), (Some(OK), done(later)));
    let late = Some(Status::ActionLate as u16);
    assert_eq!(act(&mut control, scheduled(common(now) - 1_000_000)), (late, done(now)));
    let mut client = Client { control: &mut control, from: host(1000), now };
    assert_eq!(client.write(Id::Privilege, 0).0, OK);
    assert_eq!(act(&mut control, action), (None, vec![]), "nobody controls it");
}

#[test]
fn a_silent_controller_loses_control_and_its_stream() {
    let (mut control, start) = device();
    let timeout = Duration::from_millis(3000);
    let mut client = Client { control: &mut control, from: host(1000), now: start };
    assert_eq!(client.write(Id::Privilege, CONTROL).0, OK);
    assert_eq!(client.write(Id::Heartbeat, 499).0, INVALID);
    client.write(Id::HostPort, 5000);
    assert_eq!(client.write(Id::AcquisitionStart, 1).0, OK);
    // Reading the privilege register keeps control, as often as it is done in time.
    for _ in 0..3 {
        client.now += timeout;
        assert_eq!(client.read(Id::Privilege), CONTROL);
    }
    let silent = client.now + timeout + Duration::from_millis(1);
    assert_eq!(control.expire(silent).actions, vec![Action::Stop]);
    assert!(!control.acquiring());
    assert_eq!(control.registers.stream_destination(), None);
    let mut other = Client { control: &mut control, from: host(1001), now: silent };
    assert_eq!(other.write(Id::Privilege, CONTROL).0, OK);
}

#[test]
fn errors_carry_the_status_of_the_standard() {
    let (mut control, now) = device();
    let mut client = Client { control: &mut control, from: host(1000), now };
    client.write(Id::Privilege, CONTROL);
    let read =
        |client: &mut Client<'_>, address, count| client.send(Command::ReadMemory { address, count }).0;
    assert_eq!(read(&mut client, 0x18, 4), 0x8003, "a reserved address");
    assert_eq!(read(&mut client, 2, 4), 0x8005, "not aligned");
    assert_eq!(read(&mut client, 0, 6), 0x8005, "not whole words");
    assert_eq!(read(&mut client, u32::MAX - 3, 8), 0x8003, "beyond the address space");
    assert_eq!(client.write(Id::SensorWidth, 1).0, 0x8004);
    assert_eq!(client.write(Id::Version, 1).0, 0x8004);
    for (id, value) in [
        (Id::Width, 15),
        (Id::Width, 1921),
        (Id::Height, 0),
        (Id::PixelFormat, 1),
        (Id::PacketSize, 100),
        (Id::PacketSize, 1501),
        (Id::AcquisitionMode, 3),
        (Id::AcquisitionStart, 0),
        (Id::OffsetX, 1),
    ] {
        assert_eq!(client.write(id, value).0, INVALID, "{id:?} = {value}");
    }
    let address = Id::ExposureTime.address();
    for value in [f64::NAN, 0.0, 9.9, 1e7, f64::INFINITY, -1.0] {
        let data = value.to_be_bytes().to_vec();
        assert_eq!(client.send(Command::WriteMemory { address, data }).0, INVALID, "{value} us");
    }
    let half = client.send(Command::WriteMemory { address, data: vec![0; 4] });
    assert_eq!(half.0, 0x8003, "half a number");
    // Of two writes the first is done; the answer says that the second (index 1) failed.
    let pairs = vec![(Id::Width.address(), 320), (Id::Height.address(), 9999)];
    let (status, data, _) = client.send(Command::WriteRegisters(pairs));
    assert_eq!((status, data), (INVALID, vec![0, 0, 0, 1]));
    assert_eq!((client.read(Id::Width), client.read(Id::Height)), (320, 1200));
}

#[test]
fn a_running_acquisition_locks_the_image_format() {
    let (mut control, now) = device();
    let mut client = Client { control: &mut control, from: host(1000), now };
    client.write(Id::Privilege, CONTROL);
    client.write(Id::Destination, Ipv4Addr::LOCALHOST.to_bits());
    client.write(Id::HostPort, 5000);
    client.write(Id::Height, 600);
    let (status, actions) = client.write(Id::AcquisitionStart, 1);
    let [Action::Start(stream)] = &actions[..] else { panic!("one start, found {actions:?}") };
    assert_eq!((status, stream.layout.height, stream.destination), (OK, 600, Some(host(5000))));
    for id in [Id::Width, Id::Height, Id::PacketSize, Id::GvspConfiguration, Id::TriggerMode] {
        assert_eq!(client.write(id, 1).0, DENIED, "{id:?}");
    }
    let exposure =
        Command::WriteMemory { address: Id::ExposureTime.address(), data: 2000.0f64.to_be_bytes().to_vec() };
    let (status, _, actions) = client.send(exposure);
    assert!(
        status == OK && matches!(&actions[..], [Action::Update(s)] if s.settings.exposure_us() == 2000.0)
    );
    assert_eq!(client.write(Id::AcquisitionStart, 1), (OK, vec![]), "it runs already");
    assert_eq!(client.write(Id::AcquisitionStop, 1), (OK, vec![Action::Stop]));
    assert_eq!(client.write(Id::Height, 1200).0, OK);
}

#[test]
fn software_triggers_need_their_source() {
    let (mut control, now) = device();
    let mut client = Client { control: &mut control, from: host(1000), now };
    client.write(Id::Privilege, CONTROL);
    assert_eq!(client.write(Id::TriggerSoftware, 1).0, DENIED);
    client.write(Id::TriggerMode, 1);
    client.write(Id::TriggerSource, 1);
    assert_eq!(client.write(Id::TriggerSoftware, 1), (OK, vec![]), "lost while nothing runs");
    client.write(Id::AcquisitionStart, 1);
    assert_eq!(client.write(Id::TriggerSoftware, 1), (OK, vec![Action::SoftwareTrigger]));
    // The same request id again: the acknowledge got lost, the trigger did not.
    assert_eq!(client.write(Id::TriggerSoftware, 1), (OK, vec![]));
    client.read(Id::Privilege);
    assert_eq!(client.write(Id::TriggerSoftware, 1), (OK, vec![Action::SoftwareTrigger]));
}

#[test]
fn the_timestamp_is_latched_in_camera_time() {
    let (mut control, start) = device();
    let now = start + Duration::from_secs(5);
    let mut client = Client { control: &mut control, from: host(1000), now };
    client.write(Id::Privilege, CONTROL);
    client.write(Id::TimestampControl, 2);
    client.now += Duration::from_millis(10);
    let value = u64::from(client.read(Id::TimestampHigh)) << 32 | u64::from(client.read(Id::TimestampLow));
    assert_eq!(value, 5_000_000_005);
}

#[test]
fn discovery_says_who_and_where() {
    let (mut control, now) = device();
    // Without the acknowledge flag, and from somebody who controls nothing.
    let request = Request { id: 0xffff, ack: false, command: Command::Discovery };
    let answer = control.handle(&request.encode(), host(9), now).answer.expect("always answered");
    let data = &answer[8..];
    assert_eq!(data.len(), 0xf8);
    assert_eq!(data[..8], [0, 2, 0, 0, 0x80, 0, 0, 1], "version 2.0, big-endian UTF-8");
    assert_eq!(data[10..16], [0x02, 0, 127, 0, 7, 11], "MAC");
    assert_eq!(data[0x24..0x28], [127, 0, 7, 11]);
    assert_eq!(data[0x48..0x52], *b"fourdbody\0");
    assert_eq!(data[0xd8..0xdb], *b"S1\0");
    assert_eq!(data[0xe8..0xed], *b"left\0");
}

#[test]
fn resends_come_from_the_receivers_port() {
    let (mut control, now) = device();
    let resend = ResendRequest { channel: 0, block_id: 1, first: 2, last: 3, extended: false };
    let request = Request { id: 1, ack: false, command: Command::PacketResend(resend) };
    assert_eq!(control.handle(&request.encode(), host(4000), now), Outcome::default(), "nobody controls");
    Client { control: &mut control, from: host(1000), now }.write(Id::Privilege, CONTROL);
    let outcome = control.handle(&request.encode(), host(4000), now);
    assert_eq!(outcome, Outcome { answer: None, actions: vec![Action::Resend(resend)] });
    let stranger = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 1), 4000);
    assert_eq!(control.handle(&request.encode(), stranger, now), Outcome::default());
}

fn addresses() -> impl Strategy<Value = u32> {
    let known = (0..REGISTERS.len()).prop_map(|i| REGISTERS[i].address);
    prop_oneof![8 => known, 1 => any::<u32>(), 1 => 0u32..0x1200, 1 => 0x10000u32..0x10100]
}

fn traffic() -> impl Strategy<Value = Command> {
    let value = prop_oneof![0u32..4, any::<u32>(), 0u32..2000];
    let pairs = proptest::collection::vec((addresses(), value), 1..4);
    let data = proptest::collection::vec(any::<u8>(), 1..64);
    prop_oneof![
        1 => proptest::collection::vec(addresses(), 1..5).prop_map(Command::ReadRegisters),
        4 => pairs.prop_map(Command::WriteRegisters),
        1 => (addresses(), 1u16..536).prop_map(|(address, count)| Command::ReadMemory { address, count }),
        2 => (addresses(), data).prop_map(|(address, data)| Command::WriteMemory { address, data }),
        2 => Just(Command::WriteRegisters(vec![(Id::Privilege.address(), CONTROL)])),
    ]
}

proptest! {
    #[test]
    fn any_register_traffic_leaves_a_valid_camera(
        commands in proptest::collection::vec((traffic(), 1u16..3, 0u64..2000), 1..40),
    ) {
        let (mut control, mut now) = device();
        let mut running = false;
        for (command, port, wait_ms) in commands {
            now += Duration::from_millis(wait_ms);
            let bytes = Request { id: 3, ack: true, command }.encode();
            let before = control.expire(now);
            running &= !before.actions.contains(&Action::Stop);
            let stranger = control.controller.as_ref().is_some_and(|c| c.address != host(port));
            let registers = format!("{:?}", control.registers);
            let outcome = control.handle(&bytes, host(port), now);
            let answer = outcome.answer.expect("every command is answered");
            prop_assert!(answer.len() <= 8 + 540);
            prop_assert_eq!(answer[3], bytes[3] + 1, "the acknowledge of the command");
            if stranger {
                prop_assert_eq!(registers, format!("{:?}", control.registers), "strangers change nothing");
            }
            for action in &outcome.actions {
                match action {
                    Action::Start(stream) => {
                        prop_assert!(!running, "a second start");
                        prop_assert!((16..=1920).contains(&stream.layout.width));
                        prop_assert!((1..=1200).contains(&stream.layout.height));
                        prop_assert!(stream.settings.exposure() >= Duration::from_micros(10));
                        running = true;
                    }
                    Action::Stop => running = false,
                    _ => {}
                }
            }
            prop_assert_eq!(running, control.acquiring());
        }
    }

    #[test]
    fn accepted_values_read_back(index in 0..REGISTERS.len(), value in prop_oneof![0u32..4, any::<u32>(), 16u32..10_000]) {
        let register = &REGISTERS[index];
        let commands = [
            Id::Privilege, Id::TimestampControl, Id::AcquisitionStart, Id::AcquisitionStop, Id::TriggerSoftware,
            // A secret.
            Id::ActionDeviceKey,
        ];
        prop_assume!(register.length == 4 && register.access == Access::ReadWrite && !commands.contains(&register.id));
        // The test-packet bit reads as zero, and reserved bits of the packet size register stay zero.
        let value = if register.id == Id::PacketSize { value & 0x4000_ffff } else { value };
        let (mut control, now) = device();
        let mut client = Client { control: &mut control, from: host(1), now };
        client.write(Id::Privilege, CONTROL);
        let old = client.read(register.id);
        let (status, _) = client.write(register.id, value);
        let expected = if status == OK { value } else { old };
        prop_assert_eq!(client.read(register.id), expected);
    }

    #[test]
    fn no_datagram_stops_the_camera(datagrams in proptest::collection::vec(proptest::collection::vec(any::<u8>(), 0..64), 0..20)) {
        let (mut control, now) = device();
        for datagram in datagrams {
            control.handle(&datagram, host(1), now);
        }
        let mut client = Client { control: &mut control, from: host(1), now };
        prop_assert_eq!(client.write(Id::Privilege, CONTROL).0, OK);
    }
}
