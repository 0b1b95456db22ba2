//! `fourdbody-sim check-accounting`: do recordings say what was injected?

use crate::faults::{check_with_disks, read_disk_truth, read_truth};
use fourdbody::cmds::{Exit, Failure};
use std::path::PathBuf;

/// Compare sessions with the faults that the simulator injected into them.
///
/// Every injected loss must have an accepted cause at exactly its trigger, and nothing else may be missing, unless
/// a simulated disk explains it. Prints counts per kind as JSON. Exit code 4 on any mismatch.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  fourdbody-sim check-accounting --truth target/lab/faults.jsonl target/lab/sessions/first"
)]
pub struct Args {
    /// The file of faults that `fourdbody-sim run --faults` wrote.
    #[arg(long, value_name = "FILE")]
    truth: PathBuf,
    /// The sessions, in the order in which they were recorded since the simulator started.
    #[arg(required = true, value_name = "SESSION")]
    sessions: Vec<PathBuf>,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let truth = read_truth(&args.truth).map_err(|e| Failure::new(Exit::Failure, e))?;
    let disks = read_disk_truth(&args.truth).map_err(|e| Failure::new(Exit::Failure, e))?;
    let accounting =
        check_with_disks(&truth, &disks, &args.sessions).map_err(|e| Failure::new(Exit::Failure, e))?;
    println!("{}", serde_json::json!(accounting));
    for mismatch in &accounting.listed {
        eprintln!("mismatch: {mismatch}");
    }
    Ok(if accounting.mismatches == 0 { Exit::Done } else { Exit::Corrupt })
}
