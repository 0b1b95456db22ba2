// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody-sim run`: the whole laboratory on the wire, for real nodes.

use crate::cache::{CachedImages, Manifest};
use crate::disk::{DiskPlan, SimulatedDisk};
use crate::faults::FaultPlan;
use crate::gige::{Habits, Make, TestImages};
use crate::hsu::LtcSource;
use crate::images::ImageSource;
use crate::laboratory::{Laboratory, LaboratoryOptions};
use fourdbody::base::Exit;
use fourdbody::cmds::Failure;
use fourdbody::config::Rig;
use std::collections::BTreeMap;
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// Run all cameras of a rig and the HSU, and write the configuration of the nodes that drive them.
///
/// The cameras show frames that `fourdbody-sim render` made, or, with --rig, a test image. When everything is
/// up, one line of JSON with the nodes' configuration files goes to standard output. Runs until it is killed.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  fourdbody-sim run --frames target/frames --run-dir target/lab --rate-hz 20\n  fourdbody node --config target/lab/node-a.toml"
)]
pub struct Args {
    /// The directory that `fourdbody-sim render` wrote.
    #[arg(long, value_name = "DIR", required_unless_present = "rig")]
    frames: Option<PathBuf>,
    /// A rig file, for test images instead of rendered frames.
    #[arg(long, value_name = "FILE", conflicts_with = "frames")]
    rig: Option<PathBuf>,
    /// Where configuration files and serial devices go.
    #[arg(long, value_name = "DIR")]
    run_dir: PathBuf,
    /// Where the nodes record; by default below the run directory.
    #[arg(long, value_name = "DIR")]
    sessions_dir: Option<PathBuf>,
    /// Triggers per second, instead of the rig's.
    #[arg(long, value_name = "HZ")]
    rate_hz: Option<f64>,
    /// Address of the first camera; the others follow.
    #[arg(long, default_value = "127.0.7.11")]
    first_address: Ipv4Addr,
    /// Port of the first node's API; the others follow. 0: any free ports.
    #[arg(long, default_value_t = 7401)]
    first_port: u16,
    /// Show what comes next in every session, instead of starting anew: a board that is moved between sessions.
    #[arg(long, requires = "frames", conflicts_with = "faults")]
    carry_on: bool,
    /// An input of the HSU that swings by itself, 0 to 7, and how often a second; may be repeated.
    #[arg(long, value_name = "INPUT:HZ", value_parser = swinging_input)]
    input: Vec<(u8, f64)>,
    /// Linear time code on an input of the HSU, 0 to 7, from a code on (00:00:00:00) at 24 to 30 frames a second (25).
    #[arg(long, value_name = "INPUT[:HH:MM:SS:FF[@FPS]]", conflicts_with = "actions")]
    ltc: Option<LtcSource>,
    /// Only the cameras of this node, with a rig of their heads: half a laboratory.
    #[arg(long, value_name = "NODE")]
    node: Option<String>,
    /// Node files without an HSU: the node triggers its cameras by action commands. For a rig of one node.
    #[arg(long, conflicts_with = "carry_on")]
    actions: bool,
    /// Number of frame buffers of each camera.
    #[arg(long, default_value_t = 32)]
    buffers: usize,
    /// Size of the nodes' segments, MiB.
    #[arg(long, value_name = "MIB")]
    segment_mib: Option<u64>,
    /// Faults to inject: a TOML file with tables [faults] (cameras), [disk] (the nodes' disks; needs FUSE), or
    /// [[habit]] (what single cameras do differently from others, and which make they are like). What was injected goes
    /// to faults.jsonl in the run directory.
    #[arg(long, value_name = "FILE")]
    faults: Option<PathBuf>,
    /// Seed of the faults, instead of the file's.
    #[arg(long, value_name = "N", requires = "faults")]
    fault_seed: Option<u64>,
    /// Bytes of the cameras' packets.
    #[arg(long, value_name = "BYTES", default_value_t = 9000, value_parser = clap::value_parser!(u32).range(576..=65532))]
    packet_bytes: u32,
    /// Stop after this number of seconds.
    #[arg(long, value_name = "S")]
    duration: Option<f64>,
}

fn swinging_input(text: &str) -> Result<(u8, f64), String> {
    let parts = text.split_once(':').and_then(|(line, hz)| Some((line.parse().ok()?, hz.parse().ok()?)));
    match parts {
        Some((line @ 0..=7, hz)) if (0.001..=10_000.0).contains(&hz) => Ok((line, hz)),
        _ => Err("expected an input, 0 to 7, and 0.001 to 10000 Hz, as in 2:1.5".to_owned()),
    }
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let rig_path = match (&args.frames, &args.rig) {
        (Some(frames), _) => frames.join("rig.toml"),
        (None, Some(rig)) => rig.clone(),
        (None, None) => return Err(Failure::new(Exit::Usage, "expected --frames or --rig")),
    };
    let patience = match args.duration {
        Some(seconds) if seconds > 0.0 && seconds < 1e9 => Some(Duration::from_secs_f64(seconds)),
        Some(seconds) => {
            let message = format!("--duration is {seconds}, expected seconds above 0");
            return Err(Failure::new(Exit::Usage, message));
        }
        None => None,
    };
    let mut options = LaboratoryOptions::new(rig_text(&rig_path, args)?, &args.run_dir);
    if let Some(sessions) = &args.sessions_dir {
        options.sessions_dir = sessions.clone();
    }
    options.first_address = args.first_address;
    options.first_port = args.first_port;
    options.buffers_per_camera = args.buffers;
    options.segment_mib = args.segment_mib.unwrap_or(options.segment_mib);
    options.packet_bytes = args.packet_bytes;
    options.carry_on = args.carry_on;
    options.inputs.clone_from(&args.input);
    (options.ltc, options.time_code_input) = (args.ltc, args.ltc.map(|ltc| ltc.line));
    options.trigger = args.actions.then(|| "source = \"action\"".to_owned());
    options.calibration =
        args.frames.as_ref().map(|frames| frames.join("calibration.json")).filter(|file| file.is_file());
    (options.faults, options.disk, options.habits) = fault_plans(args)?;
    options.makes = makes(args)?;
    // A mount outlives its process: a laboratory with disks must end in good order.
    let signals = options.disk.as_ref().map(|_| EndSignals::block());
    let mut images = images(args, &rig_path, &options.rig_text)?;
    let laboratory =
        Laboratory::start(&options, |_| images.remove(0)).map_err(|e| Failure::new(Exit::Failure, e))?;
    let nodes: Vec<_> = laboratory
        .nodes
        .iter()
        .map(|node| serde_json::json!({ "node": node.node, "config": node.path, "port": node.port }))
        .collect();
    println!("{}", serde_json::json!({ "ready": true, "urls": laboratory.urls(), "nodes": nodes }));
    match (signals, patience) {
        (Some(signals), patience) => drop(signals.wait(patience)),
        (None, Some(patience)) => std::thread::sleep(patience),
        (None, None) => loop {
            std::thread::park();
        },
    }
    Ok(Exit::Done)
}

/// The signals that end a program, kept from doing so at once.
pub(super) struct EndSignals(libc::sigset_t);

impl EndSignals {
    /// Blocks them in this thread and all that it will start.
    pub(super) fn block() -> Self {
        // SAFETY: a sigset_t is a plain C struct for which all-zero bytes are a valid value; the calls get pointers to
        // it that are valid for their duration.
        unsafe {
            let mut set: libc::sigset_t = std::mem::zeroed();
            libc::sigemptyset(&mut set);
            for signal in [libc::SIGINT, libc::SIGTERM, libc::SIGHUP] {
                libc::sigaddset(&mut set, signal);
            }
            libc::pthread_sigmask(libc::SIG_BLOCK, &set, std::ptr::null_mut());
            Self(set)
        }
    }

    /// Returns when one of them came (true), or the time is over.
    pub(super) fn wait(&self, patience: Option<Duration>) -> bool {
        let end = patience.map(|patience| std::time::Instant::now() + patience);
        loop {
            let left = end.map_or(Duration::from_secs(3600), |end| {
                end.saturating_duration_since(std::time::Instant::now())
            });
            let time = libc::timespec {
                tv_sec: libc::time_t::try_from(left.as_secs()).unwrap_or(3600),
                tv_nsec: libc::c_long::from(left.subsec_nanos()),
            };
            // SAFETY: both pointers are valid for the duration of the call; no information on the signal is requested.
            let signal = unsafe { libc::sigtimedwait(&self.0, std::ptr::null_mut(), &time) };
            if signal > 0 || (end.is_some() && left.is_zero()) {
                return signal > 0;
            }
        }
    }
}

/// What the cameras and what the disks do wrong, and what cameras do differently.
type Plans = (Option<FaultPlan>, Option<DiskPlan>, BTreeMap<String, Habits>);

fn fault_plans(args: &Args) -> Result<Plans, Failure> {
    let Some(path) = &args.faults else { return Ok((None, None, BTreeMap::new())) };
    let wrong = |e: &dyn std::fmt::Display| Failure::new(Exit::Usage, format!("{}: {e}", path.display()));
    let text = std::fs::read_to_string(path).map_err(|e| wrong(&e))?;
    let mut disk = DiskPlan::parse(&text).map_err(|e| wrong(&e))?;
    let habits = Habits::parse(&text).map_err(|e| wrong(&e))?;
    // A file without [faults] is no mistake where it has something else.
    let table: toml::Table = text.parse().map_err(|e| wrong(&e))?;
    let wanted = disk.is_none() && habits.is_empty() || table.contains_key("faults");
    let mut cameras = wanted.then(|| FaultPlan::parse(&text)).transpose().map_err(|e| wrong(&e))?;
    if let Some(seed) = args.fault_seed {
        disk.iter_mut().for_each(|plan| plan.seed = seed);
        cameras.iter_mut().for_each(|plan| plan.set_seed(seed));
    }
    if let Some(reason) = disk.as_ref().and_then(|_| SimulatedDisk::unavailable()) {
        return Err(wrong(&format_args!("[disk]: no disk can be simulated here: {reason}")));
    }
    Ok((cameras, disk, habits))
}

/// Which cameras are like which make.
fn makes(args: &Args) -> Result<BTreeMap<String, Arc<Make>>, Failure> {
    let Some(path) = &args.faults else { return Ok(BTreeMap::new()) };
    let wrong = |e: &dyn std::fmt::Display| Failure::new(Exit::Usage, format!("{}: {e}", path.display()));
    let text = std::fs::read_to_string(path).map_err(|e| wrong(&e))?;
    Make::parse_all(&text, path.parent().unwrap_or(Path::new("."))).map_err(|e| wrong(&e))
}

/// The rig file's text, with another trigger rate or with the cameras of one node only, on request.
fn rig_text(path: &Path, args: &Args) -> Result<String, Failure> {
    let wrong = |e: &dyn std::fmt::Display| Failure::new(Exit::Usage, format!("{}: {e}", path.display()));
    let text = std::fs::read_to_string(path).map_err(|e| wrong(&e))?;
    if args.rate_hz.is_none() && args.node.is_none() {
        return Ok(text);
    }
    let mut table: toml::Table = text.parse().map_err(|e| wrong(&e))?;
    if let Some(rate_hz) = args.rate_hz {
        table.insert("trigger_rate_hz".to_owned(), rate_hz.into());
    }
    if let Some(node) = &args.node {
        keep_node(&mut table, node);
        if table.get("head").and_then(toml::Value::as_array).is_none_or(Vec::is_empty) {
            return Err(wrong(&format_args!("no camera belongs to node {node}")));
        }
    }
    toml::to_string(&table).map_err(|e| wrong(&e))
}

/// Takes the cameras of all other nodes out of a rig, and the heads that have none left.
fn keep_node(rig: &mut toml::Table, node: &str) {
    let Some(heads) = rig.get_mut("head").and_then(toml::Value::as_array_mut) else { return };
    heads.retain_mut(|head| {
        let cameras = head.get_mut("camera").and_then(toml::Value::as_array_mut);
        cameras.is_some_and(|cameras| {
            cameras.retain(|camera| camera.get("node").and_then(toml::Value::as_str) == Some(node));
            !cameras.is_empty()
        })
    });
}

/// What each camera shows, in the rig's order.
fn images(args: &Args, rig_path: &Path, rig_text: &str) -> Result<Vec<Arc<dyn ImageSource>>, Failure> {
    let rig = match &args.node {
        // A rig of its own, which is nowhere in a file; its problems are found and reported when it is started.
        Some(_) => rig_text.parse().ok().and_then(|table| Rig::from_table(&table).ok()),
        None => Some(Rig::load(rig_path)?),
    };
    let unusable = |e| Failure::new(Exit::Failure, e);
    let manifest = args.frames.as_deref().map(Manifest::load).transpose().map_err(unusable)?;
    let mut images: Vec<Arc<dyn ImageSource>> = Vec::new();
    // Numbered from 1, as in the tests.
    for (number, (_, camera)) in (1u32..).zip(rig.iter().flat_map(Rig::cameras)) {
        images.push(match (&args.frames, &manifest) {
            (Some(frames), Some(manifest)) => {
                Arc::new(CachedImages::open(frames, manifest, &camera.id).map_err(unusable)?)
            }
            _ => {
                let (width, height) = (camera.device.width, camera.device.height);
                Arc::new(TestImages::new(width, height, number, TestImages::DISTINCT))
            }
        });
    }
    Ok(images)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_a_rig_is_a_rig() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/rig.toml");
        let mut table: toml::Table = std::fs::read_to_string(path).expect("a file").parse().expect("TOML");
        keep_node(&mut table, "b");
        let rig = Rig::from_table(&table).expect("a valid rig");
        let cameras: Vec<String> = rig.cameras().map(|(_, camera)| camera.id.to_string()).collect();
        assert_eq!(cameras, ["h2_up", "h2_low", "h3_up", "h3_low"]);
        keep_node(&mut table, "c");
        assert!(table["head"].as_array().is_some_and(Vec::is_empty));
    }
}
