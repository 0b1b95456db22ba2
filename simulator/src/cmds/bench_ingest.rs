// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody-sim bench-ingest`: what a node takes in, and what that costs; `make bench-ingest` calls it.

mod dropping;
mod others;
mod process;
mod train;

use crate::gige::loopback_cuts_before_receivers;
use fourdbody::base::Exit;
use fourdbody::cmds::Failure;
use process::failed;
use serde_json::{Map, Value};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use train::{End, Laboratory, Train, remove};

/// Number of cameras of one node.
const CAMERAS: usize = 4;
/// Pixels of one frame of the rig, as decimal billions want it.
const FRAME_BYTES: f64 = 1920.0 * 1200.0;
/// MiB of a segment where finished ones are dropped: two seconds at full rate.
const LONG_SEGMENT_MIB: u64 = 2048;

/// Measure a node that takes four cameras in and records them, beside other recorders on the same host.
///
/// Runs `fourdbody node` and the simulator as processes of their own, then a plain buffered recorder on the same
/// cameras, then receivers that throw frames away, then fio. Figures go to OUT/summary.json. Takes 22 GB of disk
/// for a moment at the default length and rate.
#[derive(clap::Args)]
#[command(after_help = "Example:\n  make bench-ingest\n  make bench-ingest LONG=1")]
pub struct Args {
    /// Where figures, logs and (for a moment) recordings go.
    #[arg(long, default_value = "target/bench-ingest")]
    out: PathBuf,
    /// Where the programs of this build are.
    #[arg(long, default_value = "target/release")]
    bin: PathBuf,
    /// The rig, of which node a's cameras take part.
    #[arg(long, default_value = "config/rig.toml")]
    rig: PathBuf,
    /// The trigger rate, triggers per second.
    #[arg(long, default_value_t = 120.0)]
    rate_hz: f64,
    /// Duration of each train, seconds.
    #[arg(long, default_value_t = 20.0)]
    duration: f64,
    /// Only one train of this many seconds, whose finished segments are dropped as it goes.
    #[arg(long, value_name = "S")]
    long: Option<f64>,
    /// Only the node's train, nothing to compare it with.
    #[arg(long)]
    node_only: bool,
    /// Full hash of the commit.
    #[arg(long)]
    commit: String,
    /// Bytes of a packet, as the node is configured; for the receivers.
    #[arg(long, default_value_t = 9000)]
    packet_bytes: u32,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    if !(args.rate_hz > 0.0 && args.rate_hz <= 1000.0 && args.duration >= 2.0 && args.duration < 1e5) {
        let message = "--rate-hz must be above 0 and at most 1000, --duration at least 2 seconds";
        return Err(Failure::new(Exit::Usage, message));
    }
    std::fs::create_dir_all(&args.out).map_err(|e| failed(format!("{}: {e}", args.out.display())))?;
    let mut summary = earlier(args);
    insert(&mut summary, "packet_bytes", args.packet_bytes);
    insert(&mut summary, "commit", args.commit.clone());
    insert(&mut summary, "machine", super::summarize::machine());
    // Nothing is left to chance: test images, no noise on the HSU's line, no fault.
    insert(&mut summary, "seed", 0);
    insert(&mut summary, "sends_segmented", loopback_cuts_before_receivers());
    let result = match args.long {
        Some(seconds) => long(args, seconds, &mut summary),
        None => all(args, &mut summary),
    };
    // Gigabytes that are not needed any more.
    remove(&args.out.join("sessions"))?;
    // What was measured before a failure stays readable.
    let text = format!("{:#}\n", Value::Object(summary));
    let path = args.out.join("summary.json");
    std::fs::write(&path, &text).map_err(|e| failed(format!("{}: {e}", path.display())))?;
    print!("{text}");
    result.map(|()| Exit::Done)
}

/// The figures of the same commit's other mode, to add to.
fn earlier(args: &Args) -> Map<String, Value> {
    let text = std::fs::read_to_string(args.out.join("summary.json")).unwrap_or_default();
    match serde_json::from_str(&text) {
        Ok(Value::Object(map)) if map.get("commit").and_then(Value::as_str) == Some(&args.commit) => map,
        _ => Map::new(),
    }
}

fn all(args: &Args, summary: &mut Map<String, Value>) -> Result<(), Failure> {
    let full = node_train(args, args.rate_hz)?;
    report(summary, "", &full);
    let frames = full.expected;
    let loss_free = if full.gaps() == 0 { Some(args.rate_hz) } else { highest_loss_free(args)? };
    insert(summary, "highest_loss_free_rate_hz", loss_free);
    if args.node_only {
        return Ok(());
    }
    let laboratory = Laboratory::start(args, args.rate_hz, 1 << 20)?;
    println!("plain buffered mcap: {} s at {} Hz", args.duration, args.rate_hz);
    let plain = train::with_plain_writer(args, &laboratory, args.rate_hz, args.duration)?;
    drop(laboratory);
    remove(&args.out.join("sessions"))?;
    report(summary, "_buffered_mcap", &plain);
    println!("receivers only: {} s at {} Hz", args.duration, args.rate_hz);
    others::receive_only(args, args.rate_hz, args.duration, summary)?;
    println!("disk only: {:.1} GB", frames as f64 * FRAME_BYTES / 1e9);
    others::disk_only(args, frames, summary)
}

fn node_train(args: &Args, rate_hz: f64) -> Result<Train, Failure> {
    println!("node: {} s at {rate_hz} Hz", args.duration);
    let laboratory = Laboratory::start(args, rate_hz, 16 << 10)?;
    let train = train::with_node(args, &laboratory, rate_hz, args.duration, End::Counted)?;
    remove(&args.out.join("sessions"))?;
    Ok(train)
}

/// Steps the rate down until a train has no gap; `None` where none is slow enough.
fn highest_loss_free(args: &Args) -> Result<Option<f64>, Failure> {
    for rate_hz in [150.0, 140.0, 130.0, 120.0, 110.0, 100.0, 90.0, 80.0, 70.0, 60.0, 40.0, 20.0] {
        if rate_hz < args.rate_hz {
            let train = node_train(args, rate_hz)?;
            if train.gaps() == 0 {
                return Ok(Some(rate_hz));
            }
            println!("  {} of {} frames missing", train.gaps(), train.expected);
        }
    }
    Ok(None)
}

fn long(args: &Args, seconds: f64, summary: &mut Map<String, Value>) -> Result<(), Failure> {
    println!("node: {seconds} s at {} Hz, finished segments are dropped", args.rate_hz);
    let laboratory = Laboratory::start(args, args.rate_hz, LONG_SEGMENT_MIB)?;
    let stop = AtomicBool::new(false);
    let (train, dropped) = std::thread::scope(|scope| {
        let dropping = scope.spawn(|| dropping::drop_segments(args, &laboratory.sessions, &stop));
        let train = train::with_node(args, &laboratory, args.rate_hz, seconds, End::Stopped);
        stop.store(true, Ordering::Release);
        (train, dropping.join())
    });
    report(summary, "_long", &train?);
    dropped.map_err(|_| failed("dropping segments panicked"))?.report(summary, "_long")
}

/// Adds the figures of a train; those that are relied on have names that the documentation lists.
fn report(summary: &mut Map<String, Value>, suffix: &str, train: &Train) {
    let [node, simulator] = train.cores.programs.as_slice() else { return };
    let mut add = |key: &str, value: Value| drop(summary.insert(format!("{key}{suffix}"), value));
    add("duration_s", train.duration_s.into());
    add("trigger_rate_hz", train.rate_hz.into());
    add("frames_expected", train.expected.into());
    add("frames_recorded", train.recorded.into());
    add("gaps", train.gaps().into());
    add("ring_high_water_frames", train.high_water.into());
    for (key, milliseconds) in &train.latencies {
        add(key, milliseconds.as_f64().map_or(Value::Null, rounded));
    }
    let per_gb =
        |cores: f64| if train.gb_per_s > 0.0 { rounded(cores / train.gb_per_s) } else { Value::Null };
    add("node_cpu_cores", rounded(node.total_s()));
    add("node_cpu_user_cores", rounded(node.user_s));
    add("node_cpu_system_cores", rounded(node.system_s));
    add("node_cpu_s_per_gb", per_gb(node.total_s()));
    add("simulator_cpu_cores", rounded(simulator.total_s()));
    add("simulator_cpu_s_per_gb", per_gb(simulator.total_s()));
    add("other_cpu_cores", rounded(train.cores.others));
    add("load_average", rounded(train.load_average));
    if train.gaps() > 0 {
        eprintln!("  {} of {} frames missing: {}", train.gaps(), train.expected, train.details);
    }
}

fn rounded(value: f64) -> Value {
    ((value * 1000.0).round() / 1000.0).into()
}

fn insert(summary: &mut Map<String, Value>, key: &str, value: impl Into<Value>) {
    let value = value.into();
    let value = value.as_f64().filter(|_| value.is_f64()).map_or(value, rounded);
    summary.insert(key.to_owned(), value);
}
