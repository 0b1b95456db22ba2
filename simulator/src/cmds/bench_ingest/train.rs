// SPDX-License-Identifier: MIT OR Apache-2.0
//! One train of triggers: the simulated laboratory, a recorder of its own, and what both cost meanwhile.

use super::process::{Cores, Program, Reading, failed, load_average};
use super::{Args, FRAME_BYTES};
use fourdbody::base::Exit;
use fourdbody::cmds::Failure;
use fourdbody::control::client::NodeClient;
use fourdbody::control::request::Phase;
use fourdbody::control::status::NodeStatus;
use serde_json::{Value, json};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

/// The figures that were measured in one train.
pub struct Train {
    pub rate_hz: f64,
    pub duration_s: f64,
    pub expected: u64,
    /// Complete frames in the file.
    pub recorded: u64,
    /// Most frames that waited for the writer.
    pub high_water: u64,
    /// Latencies of the writer by the key's name, ms; null where the recorder does not tell.
    pub latencies: Vec<(&'static str, Value)>,
    pub cores: Cores,
    /// GB of pixels per second of the measured time.
    pub gb_per_s: f64,
    /// The load average of the host before the train.
    pub load_average: f64,
    /// Further figures that the recorder reports.
    pub details: Value,
}

impl Train {
    /// Frames that are not there.
    pub fn gaps(&self) -> u64 {
        self.expected.saturating_sub(self.recorded)
    }
}

/// The simulator with the cameras of one node, as a process.
pub struct Laboratory {
    program: Program,
    pub config: PathBuf,
    url: String,
    pub sessions: PathBuf,
}

impl Laboratory {
    /// Starts it, for trains of this rate.
    pub fn start(args: &Args, rate_hz: f64, segment_mib: u64) -> Result<Self, Failure> {
        let (run_dir, sessions) = (args.out.join("lab"), args.out.join("sessions"));
        remove(&sessions)?;
        let mut command = Command::new(program(args, "fourdbody-sim"));
        command.arg("run").arg("--rig").arg(&args.rig).args(["--node", "a", "--first-port", "0"]);
        command.args(["--first-address", "127.0.9.11", "--buffers", "128"]);
        command.arg("--rate-hz").arg(rate_hz.to_string()).arg("--segment-mib").arg(segment_mib.to_string());
        command.arg("--run-dir").arg(&run_dir).arg("--sessions-dir").arg(&sessions);
        let mut program = Program::start("simulator", &mut command, &args.out)?;
        let mut line = String::new();
        BufReader::new(program.output()?).read_line(&mut line).map_err(failed)?;
        let ready: Value = serde_json::from_str(&line).map_err(|_| {
            failed(format!("the simulator did not get ready; see {}/simulator.log", args.out.display()))
        })?;
        let config = ready["nodes"][0]["config"].as_str().unwrap_or_default();
        let url = ready["urls"].as_str().unwrap_or_default();
        Ok(Self { program, config: config.into(), url: url.to_owned(), sessions })
    }
}

/// A program of this build, beside this one.
pub fn program(args: &Args, name: &str) -> PathBuf {
    args.bin.join(name)
}

/// Removes a file or directory that may not be there.
pub fn remove(path: &Path) -> Result<(), Failure> {
    let result = if path.is_dir() { std::fs::remove_dir_all(path) } else { std::fs::remove_file(path) };
    match result {
        Err(error) if path.exists() => Err(failed(format!("{}: {error}", path.display()))),
        _ => Ok(()),
    }
}

/// The condition at which a session ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum End {
    /// After the requested number of triggers: the node refuses when the disk cannot hold them.
    Counted,
    /// By its operator, who stops it once there were enough: for more than the disk can hold at a time.
    Stopped,
}

/// Records a train with a real node. What it recorded stays until the next one, or until the caller removes it.
pub fn with_node(
    args: &Args,
    laboratory: &Laboratory,
    rate_hz: f64,
    duration_s: f64,
    end: End,
) -> Result<Train, Failure> {
    let mut command = Command::new(program(args, "fourdbody"));
    let node =
        Program::start("node", command.arg("node").arg("--config").arg(&laboratory.config), &args.out)?;
    let client = NodeClient::new(&laboratory.url);
    wait_until_ready(&client, args)?;
    // Whatever the session before, and the opening of cameras, left to be written.
    std::thread::sleep(Duration::from_secs(2));
    let load_average = load_average();
    let mut command = Command::new(program(args, "fourdbody"));
    command.args(["capture", "--json", "--name", "bench", "--nodes", &laboratory.url]);
    match end {
        End::Counted => command.arg("--duration").arg(duration_s.to_string()),
        End::Stopped => command.args(["--triggers", "0"]),
    };
    let mut capture = Program::start("capture", &mut command, &args.out)?;

    let processes = [&node, &laboratory.program];
    let (mut first, mut last) = (None, None);
    let mut stop_at = (end == End::Stopped).then_some((duration_s * rate_hz) as u64);
    while !capture.ended() {
        std::thread::sleep(Duration::from_millis(50));
        let Ok(status) = client.status() else { continue };
        let Some(session) = status.session.filter(|s| status.phase == Phase::Running && s.triggers > 0)
        else {
            continue;
        };
        if stop_at.is_some_and(|enough| session.triggers >= enough) {
            stop_at = None;
            capture.signal("INT");
        }
        let reading =
            (Reading::of(&processes), session.cameras.iter().map(|camera| camera.frames).sum::<u64>());
        if first.is_none() {
            first = Some(reading);
        } else {
            last = Some(reading);
        }
    }
    let (text, status) = capture.finish()?;
    let report: Value = serde_json::from_str(&text).map_err(|_| {
        failed(format!(
            "the capture failed ({status}); see {0}/capture.log and {0}/node.log",
            args.out.display()
        ))
    })?;
    node.stop();
    let session = &report["nodes"][0]["session"];
    let (first, last) = first.zip(last).ok_or_else(|| failed("the train was too short to measure"))?;
    let cores = first.0.until(&last.0);
    let cameras = session["cameras"].as_array().map_or(&[][..], Vec::as_slice);
    let triggers = session["triggers"].as_u64().unwrap_or(0);
    Ok(Train {
        rate_hz,
        duration_s,
        expected: triggers * cameras.len() as u64,
        recorded: cameras.iter().filter_map(|camera| camera["frames"].as_u64()).sum(),
        high_water: session["ring_high_water_frames"].as_u64().unwrap_or(0),
        latencies: vec![
            ("write_p99_ms", latency_ms(session, "written", "p99_us")),
            ("write_max_ms", latency_ms(session, "written", "max_us")),
            ("durable_p99_ms", latency_ms(session, "durable", "p99_us")),
        ],
        gb_per_s: (last.1 - first.1) as f64 * FRAME_BYTES / 1e9 / cores.seconds,
        cores,
        load_average,
        details: json!({ "verdict": report["verdict"], "outcome": session["outcome"] }),
    })
}

/// One figure of a latency that the node reports in microseconds, wherever in its status that is.
fn latency_ms(session: &Value, latency: &str, figure: &str) -> Value {
    let us = find(session, latency).and_then(|latency| latency[figure].as_f64());
    us.map_or(Value::Null, |us| (us / 1000.0).into())
}

/// A key anywhere in a report.
fn find<'a>(value: &'a Value, key: &str) -> Option<&'a Value> {
    match value {
        Value::Object(map) => map.get(key).or_else(|| map.values().find_map(|inner| find(inner, key))),
        Value::Array(list) => list.iter().find_map(|inner| find(inner, key)),
        _ => None,
    }
}

fn wait_until_ready(client: &NodeClient, args: &Args) -> Result<(), Failure> {
    let begun = Instant::now();
    let ready = |status: NodeStatus| {
        let hsu = status.hsu.problem.is_none() && status.hsu.identity.is_some();
        hsu && status.cameras.iter().all(|camera| camera.problem.is_none() && camera.identity.is_some())
    };
    while !client.status().is_ok_and(ready) {
        if begun.elapsed() > Duration::from_secs(60) {
            let message = format!("the node did not get ready; see {}/node.log", args.out.display());
            return Err(Failure::new(Exit::Device, message));
        }
        std::thread::sleep(Duration::from_millis(100));
    }
    Ok(())
}

/// Records a train with a plain buffered `mcap::Writer` (`examples/ingest_buffered.rs`).
pub fn with_plain_writer(
    args: &Args,
    laboratory: &Laboratory,
    rate_hz: f64,
    duration_s: f64,
) -> Result<Train, Failure> {
    let file = laboratory.sessions.join("buffered.mcap");
    std::fs::create_dir_all(&laboratory.sessions).map_err(failed)?;
    let triggers = (duration_s * rate_hz).round().max(1.0);
    let load_average = load_average();
    let mut command = Command::new(args.bin.join("examples/ingest_buffered"));
    command.arg(&laboratory.config).arg(&file).arg(triggers.to_string());
    let mut recorder = Program::start("ingest_buffered", &mut command, &args.out)?;
    let mut lines = BufReader::new(recorder.output()?).lines();
    let mut next = |key: &str| -> Result<Value, Failure> {
        let line =
            lines.next().and_then(Result::ok).and_then(|line| serde_json::from_str::<Value>(&line).ok());
        let line = line.filter(|line| line[key] == true);
        line.ok_or_else(|| {
            failed(format!("ingest_buffered failed; see {}/ingest_buffered.log", args.out.display()))
        })
    };
    next("started")?;
    let first = Reading::of(&[&recorder, &laboratory.program]);
    let ended = next("ended")?;
    let last = Reading::of(&[&recorder, &laboratory.program]);
    next("closed")?;
    recorder.finish()?;
    let cores = first.until(&last);
    let recorded = ended["frames_recorded"].as_u64().unwrap_or(0);
    Ok(Train {
        rate_hz,
        duration_s,
        expected: ended["frames_expected"].as_u64().unwrap_or(0),
        recorded,
        high_water: ended["ring_high_water_frames"].as_u64().unwrap_or(0),
        latencies: vec![("write_p99_ms", ended["write_p99_ms"].clone())],
        gb_per_s: recorded as f64 * FRAME_BYTES / 1e9 / cores.seconds,
        cores,
        load_average,
        details: Value::Null,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn latencies_are_found_wherever_they_are() {
        let session = json!({ "cameras": [{ "frames": 3 }], "writing": { "written": { "p99_us": 12_500 } } });
        assert_eq!(latency_ms(&session, "written", "p99_us"), json!(12.5));
        assert_eq!(latency_ms(&session, "durable", "p99_us"), Value::Null);
    }
}
