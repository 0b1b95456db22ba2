// SPDX-License-Identifier: MIT OR Apache-2.0
//! A whole session of both nodes, looked at by others: `tshark` dissects its traffic, the Python package
//! `mcap` reads its recordings and a sequence of clouds.

use crate::lab::{SIZE, fourdbody, host, laboratory, start_nodes, text_of};
use crate::third_party_mcap::python;
use fourdbody::data::Cloud;
use fourdbody::formats::sequence::SequenceWriter;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

const TRIGGERS: u64 = 6;

/// A capture of all that goes to and from these addresses on the loopback interface.
struct Tshark {
    child: Child,
    file: PathBuf,
}

impl Tshark {
    /// `None`, with a printed reason, where it cannot be had.
    fn start(dir: &Path, network: &str) -> Option<Self> {
        let file = dir.join("session.pcapng");
        let log = dir.join("tshark.log");
        let started = Command::new("tshark")
            .args(["-i", "lo", "-B", "64", "-q", "-f", &format!("udp and net {network}"), "-w"])
            .arg(&file)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(std::fs::File::create(&log).expect("a log"))
            .spawn();
        let Ok(child) = started else {
            println!("skipped: tshark is not installed (Debian package tshark)");
            return None;
        };
        let mut tshark = Self { child, file };
        let deadline = Instant::now() + Duration::from_secs(20);
        loop {
            // It has written its file's header when it captures.
            if std::fs::metadata(&tshark.file).is_ok_and(|data| data.len() > 0) {
                return Some(tshark);
            }
            let ended = tshark.child.try_wait().expect("a child").is_some();
            if ended || Instant::now() > deadline {
                let said = std::fs::read_to_string(&log).unwrap_or_default();
                println!("skipped: tshark may not capture on lo: {said}");
                return None;
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Ends the capture and gives its file, when everything is in it.
    fn stop(mut self) -> PathBuf {
        // What is still on its way to the file.
        std::thread::sleep(Duration::from_secs(1));
        let pid = libc::pid_t::try_from(self.child.id()).expect("a process id");
        // SAFETY: a signal to a child that has not been waited for.
        unsafe { libc::kill(pid, libc::SIGINT) };
        self.child.wait().expect("a child");
        std::mem::take(&mut self.file)
    }
}

impl Drop for Tshark {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Rows of these fields of the packets that pass the filter; `streams` are ports that GVSP comes from.
fn dissect(capture: &Path, streams: &BTreeSet<String>, filter: &str, fields: &[&str]) -> Vec<Vec<String>> {
    let mut command = Command::new("tshark");
    command.arg("-r").arg(capture).args(["-Y", filter, "-T", "fields"]);
    for port in streams {
        command.args(["-d", &format!("udp.port=={port},gvsp")]);
    }
    for field in fields {
        command.args(["-e", field]);
    }
    let output = command.stdin(Stdio::null()).output().expect("tshark ran before");
    assert!(output.status.success(), "{}", text_of(&output));
    let rows = String::from_utf8_lossy(&output.stdout).into_owned();
    rows.lines().map(|row| row.split('\t').map(str::to_owned).collect()).collect()
}

fn count(rows: &[Vec<String>], column: usize) -> BTreeMap<&str, usize> {
    let mut counts = BTreeMap::new();
    rows.iter().for_each(|row| *counts.entry(row[column].as_str()).or_insert(0) += 1);
    counts
}

fn assert_dissects(capture: &Path, network: &str) {
    // Streams come from a port of the camera's choice; the register that tells it is in the GVCP traffic.
    let from_cameras = format!("udp && ip.src == {network} && udp.srcport != 3956");
    let sources = dissect(capture, &BTreeSet::new(), &from_cameras, &["ip.src", "udp.srcport"]);
    let sources: BTreeSet<Vec<String>> = sources.into_iter().collect();
    // Two cameras, which have addresses of their own, may be given the same number.
    assert_eq!(sources.len(), 8, "a stream port a camera: {sources:?}");
    let ports: BTreeSet<String> = sources.iter().map(|source| source[1].clone()).collect();
    let wrong = "_ws.malformed || _ws.expert.severity >= 0x00600000";
    let wrong = dissect(capture, &ports, wrong, &["frame.number", "frame.protocols", "_ws.expert.message"]);
    assert!(wrong.is_empty(), "{} packets with complaints, such as {:?}", wrong.len(), &wrong[0]);
    let rows = dissect(capture, &ports, "udp", &["frame.protocols"]);
    let protocols = count(&rows, 0);
    let of = |name: &str| -> usize {
        protocols.iter().filter(|(stack, _)| stack.ends_with(name)).map(|(_, count)| count).sum()
    };
    let (gvcp, gvsp) = (of(":gvcp"), of(":gvsp"));
    assert!(gvcp > 100 && gvcp + gvsp == rows.len(), "{protocols:?}");
    // Eight cameras: 64000 bytes a frame in packets of 9000, with a leader and a trailer; more when some were
    // asked for again.
    let formats = dissect(capture, &ports, "gvsp", &["gvsp.format"]);
    let formats = count(&formats, 0);
    let frames = 8 * TRIGGERS as usize;
    let least: usize = formats.values().sum();
    assert!(formats.len() == 3 && least >= frames * 10, "leaders, trailers, payload: {formats:?}");
    let sizes = dissect(capture, &ports, "gvsp.sizex", &["gvsp.sizex", "gvsp.sizey"]);
    assert!(sizes.len() >= frames, "{} leaders", sizes.len());
    let expected = [SIZE.0, SIZE.1].map(|side| side.to_string());
    assert!(sizes.iter().all(|row| row[..2] == expected), "{:?}", sizes[0]);
    println!("tshark: {gvcp} GVCP and {gvsp} GVSP packets, none malformed; formats {formats:?}");
}

#[test]
fn a_session_dissects_without_a_malformed_packet_and_reads_back_in_python() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 10.0);
    let network = format!("{}/24", host(laboratory.cameras[0].address(), 0));
    let tshark = Tshark::start(dir.path(), &network);
    let mut nodes = start_nodes(&laboratory);
    let captured = fourdbody(&[
        "capture",
        "--nodes",
        &laboratory.urls(),
        "--triggers",
        &TRIGGERS.to_string(),
        "--name",
        "seen",
    ]);
    assert_eq!(captured.status.code(), Some(0), "{}", text_of(&captured));
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    drop(nodes);
    if let Some(tshark) = tshark {
        assert_dissects(&tshark.stop(), &network);
    }
    let Some(python) = python() else {
        println!("skipped: no Python with the `mcap` package (`make test` installs it into tests/.venv)");
        return;
    };
    for node in ["a", "b"] {
        let segment = dir.path().join(format!("sessions/seen/node-{node}/segment-000.mcap"));
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it/third_party_mcap.py");
        let output = Command::new(&python).arg(script).arg(&segment).output().expect("Python runs");
        assert!(output.status.success(), "{}", text_of(&output));
        let found: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
        let images: u64 = found["counts"]
            .as_object()
            .expect("counts")
            .iter()
            .filter(|(topic, _)| topic.ends_with("/image"))
            .filter_map(|(_, count)| count.as_u64())
            .sum();
        assert_eq!((images, found["counts"]["/hsu/triggers"].as_u64()), (4 * TRIGGERS, Some(TRIGGERS)));
        match found["decoded"].as_u64() {
            Some(decoded) => assert_eq!(decoded, 4 * TRIGGERS),
            None => println!("frames not decoded: no Python package `mcap-protobuf-support`"),
        }
    }
}

#[test]
fn a_sequence_of_clouds_reads_back_in_python() {
    let Some(python) = python() else {
        println!("skipped: no Python with the `mcap` package (`make test` installs it into tests/.venv)");
        return;
    };
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("sequence.mcap");
    let mut writer = SequenceWriter::new(std::fs::File::create(&path).expect("a file")).expect("a sequence");
    for k in 0..3u16 {
        let numbers = 0..100 + k;
        let cloud = Cloud {
            position_m: numbers.clone().map(|i| [f32::from(i) * 0.5, f32::from(k), -1.25]).collect(),
            normal: numbers.clone().map(|_| [0.6, 0.0, -0.8]).collect(),
            intensity: numbers.clone().map(|_| 0.25).collect(),
            pixel: numbers.clone().map(|i| [i, k]).collect(),
            camera: numbers.clone().map(|i| (i % 8) as u8).collect(),
            sigma_m: numbers.map(|_| 0.0625).collect(),
        };
        writer.push(1_790_000_000_000_000_000 + u64::from(k) * 8_333_333, &cloud).expect("written");
    }
    writer.finish().expect("finished");
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it/third_party_sequence.py");
    let output = Command::new(&python).arg(script).arg(&path).output().expect("Python runs");
    assert!(output.status.success(), "{}", text_of(&output));
    let found: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let Some(points) = found["points"].as_array() else {
        println!("messages not decoded: no Python package `mcap-protobuf-support`");
        assert_eq!(found["messages"], 3);
        return;
    };
    assert_eq!(points, &[100, 101, 102]);
    assert_eq!(found["last"], serde_json::json!([50.5, 2.0, -1.25, 0.25, 0.6, 0.0, -0.8, 101, 2, 5, 0.0625]));
}
