//! `fourdbody recover`: a whole recording from an interrupted or damaged one.

use super::{Exit, Failure};
use crate::record::recover::{RecoverError, Recovered, recover};
use std::io::IsTerminal;
use std::path::PathBuf;

/// Salvage an interrupted or damaged recording into a new, complete one; the source is only read.
///
/// Exit code 0: everything is there. 3: some frames are missing, each with a gap record. 4: nothing is usable.
#[derive(clap::Args)]
#[command(after_help = "Example:\n  fourdbody recover sessions/walk-01 --out sessions/walk-01-recovered")]
pub struct Args {
    /// A session, a recording or one segment.
    #[arg(value_name = "PATH")]
    path: PathBuf,
    /// The new session's directory; it must not hold a recording of the same node.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Print one JSON object a recording.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let show = std::io::stderr().is_terminal();
    let progress = |done: u64, total: u64| {
        if show && (done.is_multiple_of(64) || done == total) {
            eprint!("\r{done} of {total} triggers{}", if done == total { "\n" } else { "" });
        }
    };
    let results = recover(&args.path, &args.out, progress).map_err(|error| {
        let exit = if matches!(error, RecoverError::Source(_)) { Exit::Corrupt } else { Exit::Failure };
        Failure::new(exit, error)
    })?;
    for result in &results {
        match args.json {
            true => println!("{}", serde_json::json!(result)),
            false => print(result),
        }
    }
    let frames: u64 = results.iter().flat_map(|r| &r.frames).map(|(_, n)| n).sum();
    let whole = results.iter().all(|r| r.verdict.gaps() == 0);
    Ok(match (frames, whole) {
        (0, _) => Exit::Corrupt,
        (_, true) => Exit::Done,
        (_, false) => Exit::DataLoss,
    })
}

fn print(result: &Recovered) {
    println!("{} -> {}", result.source.display(), result.directory.display());
    for (camera, frames) in &result.frames {
        println!("  {camera}: {frames} frames");
    }
    println!(
        "  {} damaged, {} absent; {}",
        result.damaged,
        result.absent,
        if result.was_whole { "the source was whole" } else { "the source was not whole" }
    );
    println!("{}", result.verdict);
}
