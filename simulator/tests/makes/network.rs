//! The control channel: slow answers, other clients, addresses that are given and kept.

use crate::bench::{Bench, DENIED, OK, any};
use fourdbody_simulator::gige::Habits;
use fourdbody_simulator::gige::gvcp::{Command, ForceIp, Request};
use std::net::{Ipv4Addr, UdpSocket};
use std::time::{Duration, Instant};

#[test]
fn a_slow_answer_is_announced() {
    let mut bench =
        Bench::without_control((3, 1), any(&[]), Habits { answer_late_ms: 300, ..Habits::default() });
    let id = bench.send(Command::WriteRegisters(vec![(0x0a00, 2)]));
    let start = Instant::now();
    let pending = bench.answer(id, Duration::from_secs(10)).expect("an announcement");
    assert_eq!((pending.0, pending.1, &pending.2[..]), (OK, 0x0089, &[0, 0, 1, 44][..]), "in 300 ms");
    let answer = bench.answer(id, Duration::from_secs(10)).expect("the answer");
    assert_eq!((answer.0, answer.1), (OK, 0x0083));
    assert!(start.elapsed() >= Duration::from_millis(290));
    let id = bench.send(Command::ReadRegisters(vec![0x0a00]));
    assert_eq!(
        bench.answer(id, Duration::from_secs(10)).map(|answer| answer.1),
        Some(0x0081),
        "reading is quick"
    );
}

#[test]
fn another_client_that_has_control_keeps_it_for_its_time() {
    let mut bench = Bench::without_control((3, 2), any(&[]), Habits { held_ms: 700, ..Habits::default() });
    assert_eq!(bench.take_control(), DENIED);
    assert_eq!(bench.integer("Width"), 64, "reading is free");
    let start = Instant::now();
    while bench.take_control() != OK {
        assert!(start.elapsed() < Duration::from_secs(20), "never free");
        std::thread::sleep(Duration::from_millis(50));
    }
}

fn mac(address: Ipv4Addr) -> u64 {
    0x0200_0000_0000 | u64::from(address.to_bits())
}

fn broadcast(command: Command) -> UdpSocket {
    let socket = UdpSocket::bind("127.0.0.1:0").expect("a socket");
    socket.set_broadcast(true).expect("a right of everybody");
    socket.set_read_timeout(Some(Duration::from_secs(10))).expect("a timeout");
    let request = Request { id: 9, ack: true, command };
    socket.send_to(&request.encode(), "127.255.255.255:3956").expect("sent");
    socket
}

/// The current address in the discovery answer of the camera with this MAC.
fn address_of(mac: u64) -> Ipv4Addr {
    let socket = broadcast(Command::Discovery);
    let mut answer = [0; 600];
    loop {
        let length = socket.recv(&mut answer).expect("an answer of this camera");
        let data = &answer[8..length];
        let low = u32::from_be_bytes(data[12..16].try_into().expect("4 bytes"));
        if u64::from(low) == mac & 0xffff_ffff {
            return Ipv4Addr::new(data[0x24], data[0x25], data[0x26], data[0x27]);
        }
    }
}

#[test]
fn a_camera_in_another_subnet_is_found_and_given_an_address() {
    let habits = Habits { link_local: true, ..Habits::default() };
    let mut bench = Bench::without_control((3, 3), any(&[]), habits);
    let mac = mac(bench.camera.address());
    assert_eq!(address_of(mac), Ipv4Addr::new(169, 254, 3, 3));
    let id = bench.send(Command::ReadRegisters(vec![0x0a00]));
    assert_eq!(bench.answer(id, Duration::from_millis(300)), None, "nobody reaches it there");
    let address = Ipv4Addr::new(127, 23, 3, 103);
    let force = ForceIp { mac, address, mask: Ipv4Addr::new(255, 0, 0, 0), gateway: Ipv4Addr::UNSPECIFIED };
    // One for somebody else first.
    drop(broadcast(Command::ForceIp(ForceIp { mac: mac + 1, ..force })));
    let socket = broadcast(Command::ForceIp(force));
    let mut answer = [0; 64];
    let (length, from) = socket.recv_from(&mut answer).expect("an acknowledge");
    assert_eq!((&answer[..length], from.ip()), (&[0, 0, 0, 5, 0, 0, 0, 9][..], address.into()));
    assert_eq!(address_of(mac), address);
    bench.move_client(address);
    assert_eq!(bench.take_control(), OK);
    bench.triggered();
    bench.pulses(2, Duration::from_millis(20), Duration::from_millis(1));
    assert_eq!(bench.frames().len(), 2, "it sends from there as well");
}

#[test]
fn a_persistent_address_is_kept_beside_the_one_of_now() {
    let mut bench = Bench::new((3, 4), any(&[]), Habits::default());
    let (address, length) = bench.make.register("GevPersistentIPAddress").expect("there");
    assert_eq!((address, length), (0x064c, 4));
    let kept = Ipv4Addr::new(127, 23, 3, 104);
    assert_eq!(bench.write(address, &kept.octets()), OK);
    assert_eq!(bench.read(address, 4), Ok(kept.octets().to_vec()));
    assert_eq!(bench.read(0x24, 4), Ok(vec![127, 23, 3, 4]));
}
