//! `fourdbody calibrate`: from photographs of the board to `calibration.json`.

use super::reconstruct::open_source;
use super::{Exit, Failure};
use crate::calibrate::{Board, Calibration, run as stages};
use crate::config::Rig;
use crate::ids::CameraId;
use std::path::PathBuf;

/// Calibrate all heads from photographs of the board: at each position one frame lit white, then one with fringes.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  fourdbody calibrate --rig config/rig.toml --board config/board.toml --session sessions/calibration \\\n      --out calibration.json --report calibration-report"
)]
pub struct Args {
    /// The rig file: its geometry is where the search starts, its first camera's pose defines the world.
    #[arg(long, value_name = "FILE")]
    rig: PathBuf,
    /// The board file.
    #[arg(long, value_name = "FILE")]
    board: PathBuf,
    /// A session, or a directory of images CAMERA/INDEX.png.
    #[arg(long, value_name = "DIR")]
    session: PathBuf,
    /// The calibration to write.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Leave out heads that cannot be calibrated instead of refusing.
    #[arg(long)]
    partial: bool,
    /// Print the result as one JSON object.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let rig = Rig::load(&args.rig)?;
    let board = Board::load(&args.board)?;
    let nominal = Calibration::nominal(&rig);
    let cameras: Vec<CameraId> = nominal.cameras().map(|(_, camera)| camera.id.clone()).collect();
    let source = open_source(&args.session, &cameras).map_err(|e| Failure::new(Exit::Usage, e))?;
    let outcome = stages::calibrate(source.as_ref(), &nominal, &board, args.partial)
        .map_err(|e| Failure::new(Exit::Failure, e))?;
    outcome.calibration.save(&args.out).map_err(|e| Failure::new(Exit::Failure, e))?;
    if args.json {
        println!(
            "{}",
            serde_json::json!({ "calibration": args.out, "quality": outcome.calibration.quality, "findings": outcome.findings })
        );
    } else {
        outcome.lines().iter().for_each(|line| println!("{line}"));
        println!("{}", args.out.display());
    }
    Ok(Exit::Done)
}
