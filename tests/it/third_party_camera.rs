// SPDX-License-Identifier: MIT OR Apache-2.0
//! Aravis' own programs against the simulated cameras: two implementations of GigE Vision that must agree.
//!
//! Every test has its own loopback addresses and skips, saying so, where the program is not installed.

use fourdbody_simulator::gige::{CameraOptions, SimulatedCamera, TestImages};
use fourdbody_simulator::wire::TriggerEdge;
use std::collections::HashMap;
use std::net::Ipv4Addr;
use std::process::{Command, Output};
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, PoisonError, RwLock};
use std::thread;
use std::time::{Duration, Instant};

const TOOL: &str = "arv-tool-0.8";
const CAMERA_TEST: &str = "arv-camera-test-0.8";

/// Runs a program; `None`, with a printed reason, where it is not installed.
fn run(program: &str, arguments: &[&str]) -> Option<Output> {
    match Command::new(program).args(arguments).output() {
        Ok(output) => Some(output),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            println!("skipped: {program} is not installed");
            None
        }
        Err(error) => panic!("{program} does not start: {error}"),
    }
}

fn text(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

pub fn options(address: [u8; 4]) -> CameraOptions {
    let images = TestImages::new(320, 240, u32::from(address[3]), TestImages::DISTINCT);
    let serial = format!("IT-{}-{}", address[2], address[3]);
    CameraOptions::new(&serial, Ipv4Addr::from(address), Arc::new(images))
}

pub fn start(options: CameraOptions) -> SimulatedCamera {
    SimulatedCamera::start(options).expect("a camera")
}

/// Streams of this program, which a packet socket must not see while it is made.
static STREAMS: RwLock<()> = RwLock::new(());

/// What `arv-camera-test-0.8` printed, with its final counters.
pub fn counters_of(arguments: &[&str]) -> Option<(String, HashMap<String, u64>)> {
    let _others = STREAMS.read().unwrap_or_else(PoisonError::into_inner);
    counters_alone(arguments)
}

fn counters_alone(arguments: &[&str]) -> Option<(String, HashMap<String, u64>)> {
    let printed = text(&run(CAMERA_TEST, arguments)?);
    let counters = printed
        .lines()
        .filter_map(|line| line.split_once('='))
        .filter_map(|(name, value)| Some((name.trim().to_owned(), value.trim().parse().ok()?)))
        .collect();
    Some((printed, counters))
}

/// Two seconds of a camera, with patience with a busy host: a packet counts as lost after 40 ms, a frame after
/// 400 ms.
fn patient<'a>(address: &'a str, arguments: &[&'a str]) -> Vec<&'a str> {
    let mut all = vec!["-n", address, "--duration", "2", "-j", "never"];
    all.extend(["-a", "-m", "400", "-p", "40", "-q", "1.0"]);
    all.extend(arguments);
    all
}

/// The counters of two patient seconds.
pub fn stream_counters(
    camera: &SimulatedCamera,
    arguments: &[&str],
) -> Option<(String, HashMap<String, u64>)> {
    counters_of(&patient(&camera.address().to_string(), arguments))
}

/// What the stream did wrong, if anything.
fn faults(printed: &str, counters: &HashMap<String, u64>, sent: u64) -> Vec<String> {
    let zero = [
        "n_failures",
        "n_underruns",
        "n_timeouts",
        "n_missing_frames",
        "n_size_mismatch_errors",
        "n_missing_packets",
        "n_error_packets",
        "n_ignored_packets",
    ];
    let mut faults: Vec<String> = zero
        .iter()
        .filter(|name| counters.get(**name) != Some(&0))
        .map(|name| format!("{name} = {:?}, expected 0", counters.get(*name)))
        .collect();
    if printed.lines().any(|line| line.contains("frame") && line.contains(" error")) {
        faults.push("frames with errors".to_owned());
    }
    // What was on its way when the program printed its counters is all that may differ.
    let completed = counters.get("n_completed_buffers").copied().unwrap_or(0);
    if completed <= 20 || completed > sent || sent - completed >= 30 {
        faults.push(format!("{completed} frames completed of {sent} sent"));
    }
    faults
}

/// Streams through an ordinary socket without any fault, and gives the counters.
fn stream(camera: &SimulatedCamera, arguments: &[&str]) -> Option<HashMap<String, u64>> {
    let (printed, counters) = stream_counters(camera, &[&["--no-packet-socket"], arguments].concat())?;
    let faults = faults(&printed, &counters, camera.statistics().frames_sent.load(Relaxed));
    assert!(faults.is_empty(), "{faults:?} in:\n{printed}");
    Some(counters)
}

#[test]
fn a_broadcast_finds_all_eight_cameras() {
    let cameras: Vec<_> = (1..=8).map(|host| start(options([127, 21, 1, host]))).collect();
    let Some(output) = run(TOOL, &[]) else { return };
    let printed = text(&output);
    for camera in &cameras {
        let [_, _, net, host] = camera.address().octets();
        let line = format!("fourdbody-Sim23M-IT-{net}-{host} ({})", camera.address());
        assert!(printed.contains(&line), "{line} is not in:\n{printed}");
    }
}

#[test]
fn features_are_read_back_as_written() {
    let camera = start(options([127, 21, 2, 1]));
    let address = camera.address().to_string();
    let control = |features: &[&str]| {
        let arguments = [&["-a", &address, "control"], features].concat();
        run(TOOL, &arguments).map(|output| text(&output))
    };
    let writes = [
        ("Width", "160"),
        ("Height", "120"),
        ("ExposureTime", "1234.5"),
        ("ExposureMode", "TriggerWidth"),
        ("TriggerSource", "Software"),
        ("TriggerMode", "On"),
        ("AcquisitionMode", "MultiFrame"),
        ("AcquisitionFrameCount", "7"),
        ("AcquisitionFrameRate", "75.5"),
        ("Gain", "6.5"),
        ("GevSCPSPacketSize", "1500"),
        ("GevSCPD", "1000"),
        ("GevGVSPExtendedIDMode", "On"),
        ("DeviceUserID", "left upper"),
    ];
    for (feature, value) in writes {
        let Some(printed) = control(&[&format!("{feature}={value}")]) else { return };
        assert!(printed.starts_with(&format!("{feature} = {value}")), "set: {printed}");
    }
    // A second connection sees what the first one left.
    for (feature, value) in writes {
        let printed = control(&[feature]).expect("installed");
        assert!(printed.starts_with(&format!("{feature} = {value}")), "read: {printed}");
    }
    assert!(control(&["PayloadSize"]).expect("installed").starts_with("PayloadSize = 19200"));
    // 0x8002 is what the register answers: out of range.
    let refused = control(&["R[0x10008]=100000"]).expect("installed");
    let after = control(&["Width"]).expect("installed");
    assert!(after.starts_with("Width = 160"), "{refused}\n{after}");
}

#[test]
fn a_free_running_camera_streams() {
    let camera = start(options([127, 21, 3, 1]));
    stream(&camera, &["-f", "60"]);
}

/// With the right to (as root), Aravis reads from a packet socket. Version 0.8.26 opens it before it sets
/// its filter, so any stream that runs on this host in that moment leaves foreign block ids behind, and up
/// to 99 good frames are discarded as late. That is not the camera's fault: it may try again.
#[test]
fn a_camera_streams_to_a_packet_socket() {
    let mut seen = Vec::new();
    for attempt in 1..=4 {
        let _alone = STREAMS.write().unwrap_or_else(PoisonError::into_inner);
        let camera = start(options([127, 21, 7, attempt]));
        let address = camera.address().to_string();
        let Some((printed, counters)) = counters_alone(&patient(&address, &["-f", "60"])) else { return };
        seen = faults(&printed, &counters, camera.statistics().frames_sent.load(Relaxed));
        if seen.is_empty() {
            return;
        }
        println!("attempt {attempt}: {seen:?}");
    }
    panic!("never without a fault: {seen:?}");
}

#[test]
fn a_hardware_triggered_camera_streams() {
    let (wire, triggers) = crossbeam_channel::unbounded();
    let mut options = options([127, 21, 4, 1]);
    options.triggers = triggers;
    let camera = start(options);
    let edges = thread::spawn(move || {
        let mut instant = 0;
        // Ends when the camera, and with it the other end of the wire, is gone.
        while wire.send(TriggerEdge { instant, time: Instant::now(), width_ns: 500_000 }).is_ok() {
            instant += 1;
            thread::sleep(Duration::from_millis(15));
        }
    });
    let counters = stream(&camera, &["-t", "Line0", "--features", "GevGVSPExtendedIDMode=On"]);
    if counters.is_some() {
        assert_eq!(camera.statistics().triggers_ignored.load(Relaxed), 0);
    }
    drop(camera);
    edges.join().expect("the wire");
}

#[test]
fn a_software_triggered_camera_streams() {
    let camera = start(options([127, 21, 5, 1]));
    stream(&camera, &["-o", "50", "-e", "200"]);
}

#[test]
fn lost_packets_are_sent_again() {
    for (host, ids) in [(1, "Off"), (2, "On")] {
        let mut options = options([127, 21, 6, host]);
        // Block 3 loses its leader, every fourth block one payload packet, block 9 its trailer.
        options.lose = Some(Arc::new(|block, packet| match packet {
            0 => block == 3,
            4 => block % 4 == 0,
            _ => block == 9 && packet > 30,
        }));
        let camera = start(options);
        let ids = format!("GevGVSPExtendedIDMode={ids}");
        let arguments = ["-f", "30", "-i", "2500", "--features", &ids];
        let Some(counters) = stream(&camera, &arguments) else { return };
        let resent = counters["n_resent_packets"];
        assert!(resent > 5, "{resent} packets were sent again");
        assert!(camera.statistics().packets_resent.load(Relaxed) >= resent);
    }
}
