// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody-sim check-accounting`: do recordings account for what was injected?

use crate::faults::{Shown, check_with_disks, read_disk_truth, read_truth};
use fourdbody::base::Exit;
use fourdbody::cmds::Failure;
use std::path::PathBuf;

/// Compare sessions with the faults that the simulator injected into them.
///
/// Every injected loss must have an accepted cause at exactly its trigger, and nothing else may be missing (unless
/// a simulated disk explains it), nor any pixel be another camera's or instant's. Prints counts per kind as JSON. Exit
/// code 4 on any mismatch.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  fourdbody-sim check-accounting --pixels --truth target/lab/faults.jsonl target/lab/sessions/first"
)]
pub struct Args {
    /// The file of faults that `fourdbody-sim run --faults` wrote.
    #[arg(long, value_name = "FILE")]
    truth: PathBuf,
    /// The cameras showed test images (no scenario): compare the pixels of every frame, too.
    #[arg(long)]
    pixels: bool,
    /// The sessions, in the order in which they were recorded since the simulator started.
    #[arg(required = true, value_name = "SESSION")]
    sessions: Vec<PathBuf>,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let shown = if args.pixels { Shown::TestImages } else { Shown::Scene };
    let truth = read_truth(&args.truth).map_err(|e| Failure::new(Exit::Failure, e))?;
    let disks = read_disk_truth(&args.truth).map_err(|e| Failure::new(Exit::Failure, e))?;
    let accounting = check_with_disks(&truth, &disks, &args.sessions, shown)
        .map_err(|e| Failure::new(Exit::Failure, e))?;
    println!("{}", serde_json::json!(accounting));
    for mismatch in &accounting.listed {
        eprintln!("mismatch: {mismatch}");
    }
    Ok(if accounting.mismatches == 0 { Exit::Done } else { Exit::Corrupt })
}
