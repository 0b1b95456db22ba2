// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody-sim summarize`: the demo's figures in one flat file.

use fourdbody::base::Exit;
use fourdbody::cmds::Failure;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Write the figures of a demonstration to one flat JSON object and print them.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  fourdbody-sim summarize --scenario config/scenarios/demo.toml --rate-hz 20 --capture capture.json --export export.json --score score.json --commit HASH --out summary.json"
)]
pub struct Args {
    /// The scenario, for its seed.
    #[arg(long)]
    scenario: PathBuf,
    /// The trigger rate, triggers per second.
    #[arg(long)]
    rate_hz: f64,
    /// What `fourdbody capture --json` printed.
    #[arg(long)]
    capture: PathBuf,
    /// What `fourdbody export --to mcap --json` printed of the merged clouds.
    #[arg(long)]
    export: PathBuf,
    /// What `fourdbody validate truth --json` printed.
    #[arg(long)]
    score: PathBuf,
    /// Full hash of the commit.
    #[arg(long)]
    commit: String,
    /// The JSON file to write, with all figures.
    #[arg(long)]
    out: PathBuf,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let scenario = crate::scenario::Scenario::load(&args.scenario)?;
    let capture = read(&args.capture)?;
    let export = read(&args.export)?;
    let score = read(&args.score)?;
    let nodes = capture["nodes"].as_array().map_or(&[][..], Vec::as_slice);
    let cameras: Vec<&Value> =
        nodes.iter().filter_map(|node| node["session"]["cameras"].as_array()).flatten().collect();
    let sum = |key: &str| cameras.iter().filter_map(|camera| camera[key].as_u64()).sum::<u64>();
    let triggers = nodes.iter().filter_map(|node| node["session"]["triggers"].as_u64()).max().unwrap_or(0);
    let number = |key: &str| export[key].as_u64().unwrap_or(0);
    let (clouds, points) = (number("triggers").saturating_sub(number("empty")), number("points"));
    let summary = json!({
        "cameras": cameras.len(),
        "triggers": triggers,
        "trigger_rate_hz": args.rate_hz,
        "frames_expected": triggers * cameras.len() as u64,
        "frames_recorded": sum("frames"),
        "gaps": sum("gaps"),
        "merged_clouds": clouds,
        "merged_points": points.checked_div(clouds).unwrap_or(0),
        "merged_points_scored": score["merged"]["points"],
        "merged_rms_mm": score["merged"]["rms_mm"],
        "merged_rms_right_order_mm": score["merged"]["rms_right_order_mm"],
        "merged_p95_mm": score["merged"]["p95_mm"],
        "merged_robust_mm": score["merged"]["robust_mm"],
        "wrong_order_share": score["merged"]["wrong_order_share"],
        "completeness_of_lit": score["directional"]["completeness_of_lit"],
        "commit": args.commit,
        "machine": machine(),
        "seed": scenario.seed,
    });
    let text = format!("{summary:#}\n");
    std::fs::write(&args.out, &text)
        .map_err(|e| Failure::new(Exit::Failure, format!("{}: {e}", args.out.display())))?;
    print!("{text}");
    Ok(Exit::Done)
}

pub(super) fn read(path: &Path) -> Result<Value, Failure> {
    let bytes =
        std::fs::read(path).map_err(|e| Failure::new(Exit::Failure, format!("{}: {e}", path.display())))?;
    serde_json::from_slice(&bytes).map_err(|e| {
        Failure::new(
            Exit::Failure,
            format!("{}: not JSON ({e}); did the step before it fail?", path.display()),
        )
    })
}

/// Processor and number of cores.
pub(super) fn machine() -> String {
    let cpuinfo = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = cpuinfo.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
    let name = name.map_or("unknown processor", |(_, name)| name.trim());
    let cores = std::thread::available_parallelism().map_or(0, usize::from);
    format!("{name}, {cores} cores")
}
