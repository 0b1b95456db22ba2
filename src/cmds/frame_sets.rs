// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody frame-sets`: what a node starts to have frame sets made for its console's player.

use super::failure::Failure;
use crate::base::Exit;
use crate::play::process;
use std::path::PathBuf;

/// Make frame sets of a result on request: a trigger a line comes in, packed points go out.
///
/// A node starts it for its console; `crates/node/src/play/process.rs` has the bytes.
#[derive(clap::Args)]
#[command(after_help = "\
Example:
  echo 0 | fourdbody frame-sets --rate-hz 120 --points 40000 results/walk-01 | wc --bytes")]
pub struct Args {
    /// The directory that `fourdbody reconstruct` wrote.
    result: PathBuf,
    /// Triggers per second of a result that states no times.
    #[arg(long)]
    rate_hz: f64,
    /// Points of a frame set at most.
    #[arg(long)]
    points: usize,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let (requests, points) = (std::io::stdin().lock(), std::io::stdout().lock());
    process::serve(&args.result, args.rate_hz, args.points, requests, points)
        .map_err(|e| Failure::failed(format!("frame sets cannot be exchanged with the node: {e}")))?;
    Ok(Exit::Done)
}
