// SPDX-License-Identifier: MIT OR Apache-2.0
//! Every seed of the fuzz targets goes through the targets' own functions, without a nightly compiler.
//!
//! `fuzz/seeds/TARGET` holds messages, datagrams, recordings and files as they are in good times, and inputs
//! that once broke something or reached something new. [`write_seeds`] makes the first kind anew:
//! `cargo test --test it write_seeds -- --ignored`.

#[path = "../../fuzz/src/lib.rs"]
mod bodies;

use crate::recording::{header, record};
use fourdbody_simulator::gige::gvcp::{Command, Request as Gvcp, ResendRequest};
use hsu_firmware_proto::{
    Arm, HeadTiming, Hello, HostToUnit, Identity, LinkId, MAX_MESSAGE, NodeName, Request, SessionId, Slope,
    Sync, Timing, TriggerRecord, Unit, UnitOutputs, UnitToHost, frame,
};
use std::path::{Path, PathBuf};

type Body = fn(&[u8]);

const TARGETS: [(&str, Body); 6] = [
    ("hsu_decoder", bodies::hsu::decoder),
    ("hsu_unit", bodies::hsu::unit),
    ("gvcp", bodies::gvcp::control),
    ("recording", bodies::recording::reader),
    ("config", bodies::config::files),
    ("reconstruct", bodies::reconstruct::photograph),
];

fn seeds_of(target: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/seeds").join(target)
}

fn run_seeds(target: &str) {
    let (_, body) = TARGETS.iter().find(|(name, _)| *name == target).expect("a target");
    let mut files: Vec<PathBuf> =
        seeds_of(target).read_dir().expect("seeds").map(|entry| entry.expect("an entry").path()).collect();
    files.sort();
    assert!(files.len() >= 8, "{target} has {} seeds only", files.len());
    for file in files {
        let data = std::fs::read(&file).expect("readable");
        let outcome = std::panic::catch_unwind(|| body(&data));
        assert!(outcome.is_ok(), "{target} breaks on {}", file.display());
        // What a line, a network or a disk may make of it.
        for cut in [data.len() / 2, data.len().saturating_sub(1)] {
            body(&data[..cut]);
        }
        let mut flipped = data.clone();
        if let Some(byte) = flipped.get_mut(data.len() / 3) {
            *byte ^= 0x10;
        }
        body(&flipped);
    }
}

#[test]
fn hsu_decoder_seeds() {
    run_seeds("hsu_decoder");
}

#[test]
fn hsu_unit_seeds() {
    run_seeds("hsu_unit");
}

#[test]
fn gvcp_seeds() {
    run_seeds("gvcp");
}

#[test]
fn recording_seeds() {
    run_seeds("recording");
}

#[test]
fn config_seeds() {
    run_seeds("config");
}

#[test]
fn reconstruct_seeds() {
    run_seeds("reconstruct");
}

#[test]
fn every_target_has_its_body_and_its_file() {
    let fuzz = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz");
    let manifest: toml::Table =
        std::fs::read_to_string(fuzz.join("Cargo.toml")).expect("a manifest").parse().expect("TOML");
    let bins = manifest["bin"].as_array().expect("targets");
    let names: Vec<&str> = bins.iter().filter_map(|bin| bin["name"].as_str()).collect();
    assert_eq!(names, TARGETS.map(|(name, _)| name));
    assert!(names.iter().all(|name| fuzz.join(format!("fuzz_targets/{name}.rs")).is_file()));
}

#[test]
#[ignore = "no test, writes fuzz/seeds anew: cargo test --test it write_seeds -- --ignored"]
fn write_seeds() {
    hsu_seeds();
    gvcp_seeds_from_sessions();
    recording_seeds_from_writer();
    config_seeds_from_shipped();
    reconstruct_seeds_by_hand();
}

fn write(target: &str, name: &str, data: &[u8]) {
    let dir = seeds_of(target);
    std::fs::create_dir_all(&dir).expect("a directory");
    std::fs::write(dir.join(name), data).expect("writable");
}

/// A script for the target `hsu_unit`, and the bytes of both directions for `hsu_decoder`.
struct Talk {
    unit: Unit,
    heard: Vec<UnitToHost>,
    script: Vec<u8>,
    line: Vec<u8>,
    now_ns: u64,
    id: u32,
}

struct Ear<'a>(&'a mut Vec<UnitToHost>);

impl UnitOutputs for Ear<'_> {
    fn send(&mut self, _: LinkId, message: &UnitToHost) -> bool {
        self.0.push(*message);
        true
    }

    fn fire(&mut self, _: &TriggerRecord, _: &[HeadTiming]) {}

    fn session_output(&mut self, _: bool) {}
}

const SESSION: SessionId = SessionId([7; 16]);

fn name(text: &str) -> NodeName {
    NodeName::new(text).expect("short")
}

fn timing(sync: Sync) -> Timing {
    let heads = [HeadTiming { delay_ns: 200_000, exposure_ns: 1_000_000 }; 4];
    Timing::new(8_333_333, sync, 2_000_000_000, &heads).expect("valid")
}

impl Talk {
    fn new() -> Self {
        let identity =
            Identity { name: name("fourdbody-hsu"), unique_id: *b"FUZZED-000000001", firmware: [1, 0, 0] };
        let (heard, script, line) = (Vec::new(), Vec::new(), Vec::new());
        Self { unit: Unit::new(identity), heard, script, line, now_ns: 1_000_000_000, id: 0 }
    }

    /// Both nodes have greeted the unit and configured it.
    fn configured(sync: Sync) -> Self {
        let mut talk = Self::new();
        for (link, role) in [(LinkId::A, "a"), (LinkId::B, "b")] {
            talk.say(link, Request::Hello(Hello { min: 1, current: 1, role: name(role) }));
            talk.say(link, Request::Configure(Ok(timing(sync))));
        }
        talk
    }

    fn armed(sync: Sync, trigger_count: u64, warm_up: u32) -> Self {
        let mut talk = Self::configured(sync);
        let (timing_digest, expected) = (timing(sync).digest(), [name("a"), name("b")]);
        for link in LinkId::ALL {
            talk.say(
                link,
                Request::Arm(Arm { session: SESSION, trigger_count, warm_up, timing_digest, expected }),
            );
        }
        talk
    }

    fn running(sync: Sync, trigger_count: u64, warm_up: u32) -> Self {
        let mut talk = Self::armed(sync, trigger_count, warm_up);
        talk.say(LinkId::A, Request::Start(SESSION));
        talk
    }

    fn say(&mut self, link: LinkId, request: Request) {
        self.id += 1;
        let mut message = [0; MAX_MESSAGE];
        let length = HostToUnit { request_id: self.id, request }.encode(&mut message);
        self.script.extend([(link.index() as u8) << 7, length as u8]);
        self.script.extend(&message[..length]);
        let mut framed = [0; frame::MAX_FRAME];
        let framed_length = frame::encode(&message[..length], &mut framed);
        self.line.extend(&framed[..framed_length]);
        self.unit.receive(link, self.now_ns, &message[..length], &mut Ear(&mut self.heard));
    }

    /// Time passes, in the script's steps of 50 us.
    fn wait(&mut self, steps: u16) {
        self.script.push(72);
        self.script.extend(steps.to_le_bytes());
        self.now_ns += 50_000 * u64::from(steps);
        while self.unit.next_due() <= self.now_ns {
            self.unit.tick(self.now_ns, &mut Ear(&mut self.heard));
        }
    }

    /// Frames of time code on input 3, 80 bits each, a bit 420 us long: an edge is line and direction, and steps of 5 us.
    fn time_code(&mut self, frames: &[u128]) {
        let mut rising = false;
        for frame in frames {
            let mut edges = Vec::new();
            for bit in 0..80 {
                edges.extend(if frame >> bit & 1 == 1 { vec![42u8, 42] } else { vec![84] });
            }
            self.script.extend([126, edges.len() as u8]);
            for after in edges {
                rising = !rising;
                self.script.extend([3 | u8::from(rising) << 3, after]);
                self.now_ns += 5_000 * u64::from(after);
                let slope = Slope::new(3, rising).expect("a line");
                self.unit.input(slope, self.now_ns, &mut Ear(&mut self.heard));
            }
        }
    }

    fn write(mut self, name: &str) {
        write("hsu_unit", name, &self.script);
        write("hsu_decoder", &format!("host_{name}"), &self.line);
        let mut line = vec![0x55, 0xaa, 0x00];
        for message in self.heard.drain(..) {
            let mut bytes = [0; MAX_MESSAGE];
            let length = message.encode(&mut bytes);
            let mut framed = [0; frame::MAX_FRAME];
            let framed_length = frame::encode(&bytes[..length], &mut framed);
            line.extend(&framed[..framed_length]);
        }
        write("hsu_decoder", &format!("unit_{name}"), &line);
    }
}

fn hsu_seeds() {
    let mut whole = Talk::running(Sync::Timer, 8, 2);
    (0..14).for_each(|_| whole.wait(167));
    whole.say(LinkId::B, Request::QueryTriggers { session: SESSION, first: -2, count: 12 });
    whole.say(LinkId::A, Request::ReadStatus);
    whole.say(LinkId::A, Request::Goodbye);
    whole.write("whole_session");

    let mut stopped = Talk::running(Sync::Timer, 0, 0);
    (0..5).for_each(|_| stopped.wait(200));
    stopped.say(LinkId::A, Request::ReadClock { token: 5 });
    stopped.say(LinkId::B, Request::Stop(SESSION));
    stopped.wait(400);
    stopped.write("until_stopped");

    // Ticks that come late and then early: the schedule moves, and the next trigger keeps its distance.
    let mut uneven = Talk::running(Sync::Timer, 12, 0);
    (0..8).for_each(|i| uneven.wait(if i % 3 == 0 { 240 } else { 130 }));
    uneven.write("uneven_ticks");

    let mut silent = Talk::armed(Sync::Timer, 100, 0);
    silent.wait(41_000);
    silent.write("silent_before_start");

    let mut endless = Talk::running(Sync::Timer, 0, 0);
    (0..4).for_each(|_| endless.wait(20_000));
    endless.write("silent_while_running");

    let mut projector = Talk::running(Sync::ProjectorFrame, 4, 0);
    for _ in 0..6 {
        projector.wait(167);
        projector.script.push(112);
        let now_ns = projector.now_ns;
        projector.unit.frame_sync(now_ns, &mut Ear(&mut projector.heard));
    }
    projector.wait(500);
    projector.write("projector_frames");

    let mut again = Talk::armed(Sync::Timer, 3, 1);
    again.say(LinkId::B, Request::Hello(Hello { min: 1, current: 9, role: name("b") }));
    again.say(LinkId::A, Request::Start(SESSION));
    again.say(LinkId::A, Request::Disarm(SESSION));
    again.say(LinkId::A, Request::ReadTiming);
    again.say(LinkId::A, Request::Heartbeat);
    again.script.extend([120, 9]);
    again.unit.hardware_fault(9, again.now_ns, &mut Ear(&mut again.heard));
    again.write("withdrawn_and_refused");

    let mut time_code = Talk::configured(Sync::Timer);
    time_code.say(LinkId::A, Request::SetTimeCode(Some(3)));
    time_code.say(LinkId::B, Request::SetTimeCode(Some(4)));
    // 12:34:56:08 to 10, with user bits.
    let bits = [0xbffc_2952_2356_6401_2088u128, 0xbffc_2152_2356_6401_2089, 0xbffc_2152_2356_6401_2180];
    time_code.time_code(&bits);
    time_code.say(LinkId::B, Request::QueryTimeCodes { first: 0 });
    time_code.write("time_code");

    // The same bytes as they come over a line, with noise between the frames.
    let mut line = Talk::armed(Sync::Timer, 2, 0).line;
    line.splice(0..0, [1, 2, 3, 0, 9]);
    let lines: Vec<u8> = line.chunks(200).flat_map(|c| [&[64, c.len() as u8], c].concat()).collect();
    write("hsu_unit", "over_the_line", &lines);
    write("hsu_unit", "full_line", &[&[124][..], &Talk::running(Sync::Timer, 2, 0).script].concat());
}

fn datagram(sender: u8, wait: u8, command: Command) -> Vec<u8> {
    let bytes = Gvcp { id: 5 + u16::from(wait), ack: true, command }.encode();
    [&[sender, wait][..], &(bytes.len() as u16).to_le_bytes(), &bytes].concat()
}

fn gvcp_seeds_from_sessions() {
    let write_register = |address, value| Command::WriteRegisters(vec![(address, value)]);
    let control = || datagram(0, 0, write_register(0x0a00, 2));
    let stream = || {
        let values = [(0x0d00, 40_000), (0x0d18, 0x7f00_0001), (0x0d04, 0x4000_05dc)];
        let writes = values.map(|(address, value)| datagram(0, 1, write_register(address, value)));
        [control(), writes.concat()].concat()
    };
    let start = || datagram(0, 2, write_register(0x10028, 1));
    let resend = |extended| {
        Command::PacketResend(ResendRequest { channel: 0, block_id: 3, first: 1, last: 9, extended })
    };
    let read = |address, count| datagram(1, 0, Command::ReadMemory { address, count });
    let seeds: [(&str, Vec<u8>); 12] = [
        ("discovery", datagram(3, 0, Command::Discovery)),
        ("description", [read(0x200, 512), read(0xf0_0000, 536), read(0x48, 32)].concat()),
        ("registers", datagram(1, 0, Command::ReadRegisters(vec![0, 0x934, 0xa00, 0x10008]))),
        ("start_and_stop", [stream(), start(), datagram(0, 9, write_register(0x1002c, 1))].concat()),
        (
            "silent_controller",
            [
                stream(),
                start(),
                datagram(1, 255, Command::Discovery),
                read(0xa00, 4),
                datagram(1, 255, Command::Discovery),
            ]
            .concat(),
        ),
        (
            "stranger",
            [
                control(),
                datagram(1, 1, write_register(0x10008, 640)),
                datagram(1, 1, write_register(0xa00, 1)),
            ]
            .concat(),
        ),
        (
            "settings",
            [
                control(),
                datagram(0, 1, Command::WriteRegisters(vec![(0x10008, 640), (0x1000c, 480), (0x10064, 1)])),
                datagram(
                    0,
                    1,
                    Command::WriteMemory { address: 0x10048, data: 1500f64.to_be_bytes().to_vec() },
                ),
            ]
            .concat(),
        ),
        ("locked", [stream(), start(), datagram(0, 1, write_register(0x10008, 640))].concat()),
        ("test_packet", [stream(), datagram(0, 1, write_register(0x0d04, 0xc000_0578))].concat()),
        ("resend", [stream(), start(), datagram(0, 1, resend(false)), datagram(0, 1, resend(true))].concat()),
        (
            "software_trigger",
            [
                stream(),
                datagram(0, 1, write_register(0x10068, 2)),
                start(),
                datagram(0, 1, write_register(0x10070, 1)),
            ]
            .concat(),
        ),
        (
            "malformed",
            vec![0, 0, 8, 0, 0x42, 1, 0, 0x82, 0, 7, 0, 5, 1, 1, 9, 0, 0x42, 1, 0, 0x99, 0, 1, 0, 6, 7],
        ),
    ];
    seeds.iter().for_each(|(name, data)| write("gvcp", name, data));
}

fn recording_seeds_from_writer() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let segment =
        |name: &str, cameras: &[&str], expected, triggers, missing: &[(usize, u64)], number: u32| {
            let path = dir.path().join(name);
            record(&path, header("a", cameras, expected), triggers, missing);
            std::fs::read(path.join(format!("segment-{number:03}.mcap"))).expect("a segment")
        };
    let whole = segment("whole", &["h0_up", "h0_low"], Some(3), 3, &[], 0);
    write("recording", "whole", &whole);
    write("recording", "gaps", &segment("gaps", &["h0_up", "h0_low"], Some(5), 4, &[(0, 1), (1, 3)], 0));
    write("recording", "no_triggers", &segment("none", &["h1_up"], None, 0, &[], 0));
    write("recording", "second_segment", &segment("split", &["h0_up", "h0_low"], None, 27, &[(1, 26)], 1));
    for (name, share) in [("cut_early", 0.4), ("cut_in_frames", 0.7), ("cut_in_index", 0.93)] {
        write("recording", name, &whole[..(whole.len() as f64 * share) as usize]);
    }
    let mut zero_tail = whole[..whole.len() / 2].to_vec();
    zero_tail.resize(whole.len(), 0);
    write("recording", "zero_tail", &zero_tail);
    write("recording", "twice", &[&whole[..], &whole[..]].concat());
}

fn config_seeds_from_shipped() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
    let read = |name: &str| std::fs::read_to_string(root.join(name)).expect("in the repository");
    let seed = |name: &str, kind: &str, text: &str| write("config", name, format!("{kind}{text}").as_bytes());
    let rig = read("rig.toml");
    seed("rig", "r", &rig);
    seed("rig_of_nothing", "r", "format = 1\nname = \"x\"\n");
    seed(
        "rig_with_odd_numbers",
        "r",
        &rig.replace("1920", "-1").replace("120.0", "nan").replace("0.0", "1e400"),
    );
    seed("rig_with_huge_numbers", "r", &rig.replace("1920", "9223372036854775807"));
    // Paths with slashes are not for the fuzzer.
    let node =
        read("node-a.toml").replace("/dev/fourdbody-hsu", "hsu").replace("/var/lib/fourdbody/sessions", "s");
    seed("node", "n", &node);
    seed(
        "node_with_odd_numbers",
        "n",
        &node.replace("4096", "1e9").replace("9000", "0").replace("64 ", "-4 "),
    );
    for name in ["plane", "sphere", "demo", "board", "walk_in_place"] {
        let text = read(&format!("scenarios/{name}.toml")).replace("../rig.toml", "rig.toml");
        seed(&format!("scenario_{name}"), "s", &text);
    }
}

/// Scripts for the target `reconstruct`: changes of the calibration (which, how, by), then of the frames (kind and frame, value, u, v,
/// width, height).
fn reconstruct_seeds_by_hand() {
    let whole = [0, 0, 255, 255];
    let frame = |kind: u8, value: u8, place: [u8; 4]| [[kind, value].as_slice(), &place].concat();
    let seeds: [(&str, Vec<u8>); 18] = [
        ("good", vec![0]),
        ("good_with_rows", vec![0x20]),
        ("good_by_the_papers_method", vec![0x80]),
        ("good_with_maps", vec![0x40]),
        ("black", [vec![0], frame(0, 0, whole)].concat()),
        ("white", [vec![0x80], frame(0, 255, whole)].concat()),
        ("saturated", [vec![0], frame(1, 3, whole)].concat()),
        ("dark", [vec![0], frame(2, 60, whole)].concat()),
        ("noisy", [vec![0x40], frame(3, 90, whole)].concat()),
        ("hand_before_it", [vec![0], frame(0, 120, [60, 10, 40, 60])].concat()),
        ("without_marker", [vec![0], frame(0, 2, [88, 0, 20, 80])].concat()),
        ("one_of_three_over_exposed", [vec![0], frame(6, 7, whole)].concat()),
        ("one_of_three_dark", [vec![0x20], frame(2, 11, whole)].concat()),
        ("hand_before_the_neighbour", [vec![0], frame(10, 120, [60, 10, 40, 60])].concat()),
        ("no_number", vec![1, 0, 0, 0, 0]),
        ("short_focus", vec![1, 0, 5, 0, 0]),
        ("twisted_lens", vec![2, 4, 9, 0, 240, 14, 9, 9, 2]),
        ("other_period", [vec![1, 18, 6, 0, 64], frame(3, 30, whole)].concat()),
    ];
    seeds.iter().for_each(|(name, data)| write("reconstruct", name, data));
}
