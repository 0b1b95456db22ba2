//! `fourdbody export`: stored phase maps to clouds.

use super::{Exit, Failure};
use crate::calibrate::Calibration;
use crate::reconstruct::stored;
use std::path::PathBuf;

/// Turn stored phase maps into the clouds that `reconstruct` would have written.
///
/// Given the same calibration the files are the same, byte for byte: clouds/, merged/ and sequence.mcap.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  fourdbody reconstruct sessions/walk-01 --calibration calibration.json --out walk-01 --format phase\n  fourdbody export walk-01 --calibration calibration.json --out walk-01"
)]
pub struct Args {
    /// What `fourdbody reconstruct --format phase` wrote (with phases/ in it).
    directory: PathBuf,
    /// The calibration that it was reconstructed with.
    #[arg(long, value_name = "FILE")]
    calibration: PathBuf,
    /// Where clouds/, merged/ and sequence.mcap go.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// What to write.
    #[arg(long, value_enum, default_value = "ply")]
    to: Target,
    /// Number of threads [default: one per core].
    #[arg(long, value_name = "N")]
    jobs: Option<usize>,
    /// Triggers per second, for the times in sequence.mcap where the session did not tell them.
    #[arg(long, value_name = "HZ", default_value_t = 120.0, value_parser = super::reconstruct::parse_rate)]
    rate_hz: f64,
    /// Print the summary as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Target {
    /// Binary PLY, and the merged clouds as MCAP.
    Ply,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let Target::Ply = args.to;
    super::reconstruct::keep_freed_memory();
    let calibration = Calibration::load(&args.calibration).map_err(|e| Failure::new(Exit::Usage, e))?;
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(args.jobs.unwrap_or(0))
        .build()
        .map_err(|e| Failure::new(Exit::Failure, e))?;
    let made = pool
        .install(|| stored::export(&args.directory, &calibration, &args.out, args.rate_hz))
        .map_err(|e| Failure::new(Exit::Corrupt, e))?;
    if args.json {
        println!("{}", serde_json::json!(made));
    } else {
        let (clouds, points, triggers) = (made.clouds, made.merged_points, made.triggers);
        println!("{clouds} clouds; {points} points in {triggers} merged clouds");
    }
    Ok(Exit::Done)
}
