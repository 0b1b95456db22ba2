// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whole cameras over real sockets, received by the plainest receiver that the standard allows.

use super::super::gvcp::{Command, Request, ResendRequest};
use super::super::map::Id;
use super::super::{TestImages, TestStamp};
use super::*;
use crossbeam_channel::Sender;
use std::collections::BTreeMap;

const WIDTH: usize = 64;
const HEIGHT: usize = 48;
/// Pixels per packet at packet size 576 with extended ids.
const PACKET_SIZE: u32 = 576;

fn options(host: u8) -> (CameraOptions, Sender<TriggerEdge>) {
    let images = TestImages::new(WIDTH, HEIGHT, 9, 50);
    let mut options = CameraOptions::new("TEST", Ipv4Addr::new(127, 22, 0, host), Arc::new(images));
    let (wire, triggers) = unbounded();
    options.triggers = triggers;
    (options, wire)
}

/// One packet as received: status, block id, format, packet id, rest.
struct Packet {
    status: u16,
    block: u64,
    format: u8,
    id: u32,
    body: Vec<u8>,
}

/// An image whose packets have all arrived.
struct Image {
    timestamp: u64,
    pixels: Vec<u8>,
}

/// A controller and receiver: control socket and stream socket.
struct Receiver {
    control: UdpSocket,
    stream: UdpSocket,
    extended: bool,
    next_request: u16,
}

impl Receiver {
    fn new(camera: &SimulatedCamera, extended: bool, triggered: bool) -> Self {
        let socket = |peer: Option<SocketAddrV4>| {
            let socket = UdpSocket::bind("127.0.0.1:0").expect("a socket");
            socket.set_read_timeout(Some(Duration::from_secs(5))).expect("a timeout");
            if let Some(peer) = peer {
                socket.connect(peer).expect("a route");
            }
            socket
        };
        let control = socket(Some(SocketAddrV4::new(camera.address(), gvcp::PORT)));
        let mut receiver = Self { control, stream: socket(None), extended, next_request: 1 };
        let port = receiver.stream.local_addr().expect("an address").port();
        receiver.write(Id::Privilege, 2);
        receiver.write(Id::Destination, Ipv4Addr::LOCALHOST.to_bits());
        receiver.write(Id::HostPort, u32::from(port));
        receiver.write(Id::PacketSize, PACKET_SIZE);
        receiver.write(Id::GvspConfiguration, if extended { 1 << 30 } else { 0 });
        receiver.write(Id::TriggerMode, u32::from(triggered));
        receiver
    }

    /// Status and payload of the acknowledge.
    fn ask(&mut self, command: Command) -> (u16, Vec<u8>) {
        let request = Request { id: self.next_request, ack: true, command };
        self.next_request += 1;
        self.control.send(&request.encode()).expect("sent");
        let mut buffer = [0; 600];
        let length = self.control.recv(&mut buffer).expect("an acknowledge");
        (u16::from_be_bytes([buffer[0], buffer[1]]), buffer[8..length].to_vec())
    }

    fn request(&mut self, command: Command) -> Vec<u8> {
        let (status, payload) = self.ask(command.clone());
        assert_eq!(status, 0, "status of {command:?}");
        payload
    }

    fn write(&mut self, id: Id, value: u32) {
        self.request(Command::WriteRegisters(vec![(id.address(), value)]));
    }

    fn read(&mut self, id: Id) -> u32 {
        let data = self.request(Command::ReadRegisters(vec![id.address()]));
        u32::from_be_bytes(data.try_into().expect("one register"))
    }

    fn resend(&mut self, block_id: u64, first: u32, last: u32) {
        let resend = ResendRequest { channel: 0, block_id, first, last, extended: self.extended };
        let request = Request { id: 999, ack: false, command: Command::PacketResend(resend) };
        self.control.send(&request.encode()).expect("sent");
    }

    fn packet(&self) -> Packet {
        let mut buffer = [0; 2000];
        let length = self.stream.recv(&mut buffer).expect("a stream packet");
        let be =
            |range: std::ops::Range<usize>| buffer[range].iter().fold(0u64, |n, b| n << 8 | u64::from(*b));
        let (block, id, header) = match self.extended {
            true => (be(8..16), be(16..20) as u32, 20),
            false => (be(2..4), be(5..8) as u32, 8),
        };
        assert_eq!(buffer[4] & 0x80 != 0, self.extended, "extended id flag");
        let body = buffer[header..length].to_vec();
        Packet { status: be(0..2) as u16, block, format: buffer[4] & 0x7f, id, body }
    }

    /// Receives until so many images are complete.
    fn images(&self, count: usize) -> BTreeMap<u64, Image> {
        let chunk = PACKET_SIZE as usize - 28 - if self.extended { 20 } else { 8 };
        let trailer_id = (WIDTH * HEIGHT).div_ceil(chunk) as u32 + 1;
        let mut parts: BTreeMap<u64, BTreeMap<u32, Packet>> = BTreeMap::new();
        let complete = |parts: &BTreeMap<u64, BTreeMap<u32, Packet>>| {
            parts.values().filter(|p| p.len() == trailer_id as usize + 1).count()
        };
        while complete(&parts) < count {
            let packet = self.packet();
            let format = match packet.id {
                0 => 1,
                id if id == trailer_id => 2,
                _ => 3,
            };
            assert_eq!(packet.format, format, "format of packet {}", packet.id);
            parts.entry(packet.block).or_default().insert(packet.id, packet);
        }
        let image = |packets: BTreeMap<u32, Packet>| {
            let timestamp = u64::from_be_bytes(packets[&0].body[4..12].try_into().expect("a leader"));
            let payload = packets.into_values().filter(|p| p.format == 3);
            Image { timestamp, pixels: payload.flat_map(|p| p.body).collect() }
        };
        let whole = parts.into_iter().filter(|(_, p)| p.len() == trailer_id as usize + 1);
        whole.map(|(block, packets)| (block, image(packets))).collect()
    }
}

/// A camera counts what it sent after it sent it: waits until the counter is there, and not beyond.
fn reaches(counter: &AtomicU64, expected: u64) {
    let deadline = Instant::now() + Duration::from_secs(5);
    while counter.load(Relaxed) < expected && Instant::now() < deadline {
        std::thread::yield_now();
    }
    assert_eq!(counter.load(Relaxed), expected);
}

fn edge(instant: i64, time: Instant) -> TriggerEdge {
    TriggerEdge { instant, time, width_ns: 100_000 }
}

#[test]
fn every_edge_becomes_one_frame_of_its_instant() {
    for (host, extended) in [(1, false), (2, true)] {
        let (mut options, wire) = options(host);
        options.clock = ClockOptions { offset_ns: 777, drift_ppm: 50.0 };
        let camera = SimulatedCamera::start(options).expect("a camera");
        let mut receiver = Receiver::new(&camera, extended, true);
        wire.send(edge(-9, Instant::now())).expect("wired");
        receiver.write(Id::AcquisitionStart, 1);
        let start = Instant::now();
        // Twenty edges on schedule; instants need not count from 0.
        let edges: Vec<_> =
            (0..20).map(|k| edge(k + 7, start + Duration::from_millis(5 * k as u64))).collect();
        for edge in &edges {
            wire.send(*edge).expect("wired");
        }
        let images = receiver.images(edges.len());
        assert_eq!(images.keys().copied().collect::<Vec<_>>(), (1..=20).collect::<Vec<_>>());
        for (edge, image) in edges.iter().zip(images.values()) {
            let stamp = TestStamp { camera: 9, instant: edge.instant as u32 };
            assert_eq!(TestImages::identify(&image.pixels, WIDTH), Ok(stamp));
            assert_eq!(image.timestamp, camera.clock().at(edge.time), "exposure start in camera time");
        }
        // The edge before the start.
        reaches(&camera.statistics().edges_unheard, 1);
        reaches(&camera.statistics().frames_sent, 20);
    }
}

#[test]
fn edges_during_an_exposure_cost_no_block_id() {
    let (options, wire) = options(3);
    let camera = SimulatedCamera::start(options).expect("a camera");
    let mut receiver = Receiver::new(&camera, true, true);
    // 12 ms exposure, an edge every 5 ms: one of three is accepted.
    receiver.request(Command::WriteMemory {
        address: Id::ExposureTime.address(),
        data: 12_000.0f64.to_be_bytes().to_vec(),
    });
    receiver.write(Id::AcquisitionStart, 1);
    let start = Instant::now();
    for k in 0..9 {
        wire.send(edge(k, start + Duration::from_millis(5 * k as u64))).expect("wired");
    }
    let images = receiver.images(3);
    let instants: Vec<_> = images
        .values()
        .map(|i| TestImages::identify(&i.pixels, WIDTH).expect("a whole image").instant)
        .collect();
    assert_eq!((images.keys().copied().collect(), instants), (vec![1, 2, 3], vec![0, 3, 6]));
    reaches(&camera.statistics().triggers_ignored, 6);
    assert_eq!(receiver.read(Id::TriggersIgnored), 6);
}

#[test]
fn lost_packets_can_be_had_again() {
    for (host, extended) in [(4, false), (5, true)] {
        let (mut options, wire) = options(host);
        options.resend_frames = 2;
        options.lose = Some(Arc::new(|block, packet| block == 3 && packet < 3));
        let camera = SimulatedCamera::start(options).expect("a camera");
        let mut receiver = Receiver::new(&camera, extended, true);
        receiver.write(Id::AcquisitionStart, 1);
        let start = Instant::now();
        for k in 0..3 {
            wire.send(edge(k, start + Duration::from_millis(2 * k as u64))).expect("wired");
        }
        let first_of_third = loop {
            let packet = receiver.packet();
            if packet.block == 3 {
                break packet;
            }
        };
        assert_eq!(first_of_third.id, 3, "0, 1 and 2 are lost");
        while receiver.packet().format != 2 {}
        receiver.resend(3, 0, 2);
        for id in 0..3 {
            let packet = receiver.packet();
            assert_eq!((packet.status, packet.block, packet.id), (0x0100, 3, id));
            if id == 1 {
                assert_eq!(packet.body[..8], [0, 0, 0, 9, 0, 0, 0, 2], "the stamp of camera 9, instant 2");
            }
        }
        // Block 1 has left the memory of two frames, block 4 never was.
        for block in [1, 4] {
            receiver.resend(block, 0, 5);
            let packet = receiver.packet();
            assert_eq!((packet.status, packet.block), (0x800c, block));
        }
        reaches(&camera.statistics().packets_resent, 3);
        reaches(&camera.statistics().resends_unavailable, 2);
    }
}

#[test]
fn standard_ids_wrap_and_skip_zero() {
    let (mut options, _wire) = options(6);
    options.first_block_id = 0xfffe;
    let camera = SimulatedCamera::start(options).expect("a camera");
    let mut receiver = Receiver::new(&camera, false, false);
    receiver.write(Id::AcquisitionMode, 2);
    receiver.write(Id::FrameCount, 4);
    receiver.write(Id::AcquisitionStart, 1);
    let images = receiver.images(4);
    let by_block: Vec<_> = images
        .iter()
        .map(|(block, i)| (*block, TestImages::identify(&i.pixels, WIDTH).expect("a whole image").instant))
        .collect();
    assert_eq!(by_block, vec![(1, 2), (2, 3), (0xfffe, 0), (0xffff, 1)]);
    // The acquisition ends by itself after its last frame, and the format is no longer locked.
    let unlock = || Command::WriteRegisters(vec![(Id::Width.address(), 32)]);
    let deadline = Instant::now() + Duration::from_secs(5);
    while receiver.ask(unlock()).0 != 0 {
        assert!(Instant::now() < deadline, "the acquisition does not end");
    }
    reaches(&camera.statistics().frames_sent, 4);
}

#[test]
fn a_smaller_image_is_the_top_left_crop() {
    let (options, _wire) = options(7);
    let images = Arc::clone(&options.images);
    let camera = SimulatedCamera::start(options).expect("a camera");
    let mut receiver = Receiver::new(&camera, true, false);
    receiver.write(Id::Width, 40);
    receiver.write(Id::Height, 30);
    receiver.write(Id::AcquisitionMode, 1);
    receiver.write(Id::AcquisitionStart, 1);
    let mut pixels = Vec::new();
    loop {
        let packet = receiver.packet();
        match packet.format {
            1 => assert_eq!(packet.body[16..24], [0, 0, 0, 40, 0, 0, 0, 30], "size in the leader"),
            3 => pixels.extend(packet.body),
            _ => break,
        }
    }
    let expected: Vec<u8> =
        images.pixels(0).chunks(WIDTH).take(30).flat_map(|row| &row[..40]).copied().collect();
    assert_eq!(pixels, expected);
    // Packets sent again are cut from the same crop.
    receiver.resend(1, 2, 2);
    assert_eq!(receiver.packet().body, expected[528..1056]);
}

#[test]
fn a_controller_that_falls_silent_stops_its_stream() {
    let (options, _wire) = options(8);
    let camera = SimulatedCamera::start(options).expect("a camera");
    let mut receiver = Receiver::new(&camera, true, false);
    receiver.write(Id::Heartbeat, 500);
    receiver.write(Id::AcquisitionStart, 1);
    receiver.images(2);
    // Frames come until the heartbeat runs out, then no more.
    receiver.stream.set_read_timeout(Some(Duration::from_millis(700))).expect("a timeout");
    let started = Instant::now();
    while receiver.stream.recv(&mut [0; 2000]).is_ok() {
        assert!(started.elapsed() < Duration::from_secs(20), "the stream outlives its controller");
    }
    assert_eq!(receiver.read(Id::Privilege), 0);
    assert_eq!(receiver.read(Id::HostPort), 0);
}

#[test]
fn test_packets_have_the_size_asked_for() {
    let (options, _wire) = options(9);
    let camera = SimulatedCamera::start(options).expect("a camera");
    let mut receiver = Receiver::new(&camera, false, false);
    receiver.write(Id::PacketSize, 1 << 31 | 1 << 30 | 1500);
    let mut buffer = [0; 2000];
    assert_eq!(receiver.stream.recv(&mut buffer).expect("a test packet"), 1500 - 28);
    assert_eq!(receiver.read(Id::PacketSize), 1 << 30 | 1500, "the fire bit reads as zero");
}

#[test]
fn two_cameras_cannot_share_an_address() {
    let (options, _wire) = options(10);
    let _first = SimulatedCamera::start(options.clone()).expect("a camera");
    let second = SimulatedCamera::start(options);
    assert!(matches!(second, Err(CameraError::Bind { .. })), "{second:?}");
}
