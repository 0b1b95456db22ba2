// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody calibrate`: from photographs of the board to `calibration.json`.

use super::calibrate_live::{self, Live};
use super::connect::Shown;
use super::failure::{Failure, tell_lost};
use super::reconstruct::open_source;
use crate::base::Exit;
use crate::base::ids::CameraId;
use crate::calibrate::joined::Joined;
use crate::calibrate::rigging::StageError;
use crate::calibrate::{Board, Vertical, advice, report, run};
use crate::capture::participant::Participant;
use crate::config::Rig;
use crate::data::{Calibration, FrameSource};
use std::path::PathBuf;

/// Calibrate all heads from photographs of the board: at each position one frame lit white, then one with fringes.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  fourdbody calibrate --rig config/rig.toml --board config/board.toml --session sessions/calibration \\\n      --out calibration.json --report calibration-report\n  fourdbody calibrate --rig config/rig.toml --board config/board.toml --live \\\n      --nodes http://127.0.0.1:7401,http://127.0.0.1:7402 --out calibration.json"
)]
pub struct Args {
    /// The rig file: its geometry is where the search starts, and the world is where the cameras fit it best.
    #[arg(long, value_name = "FILE")]
    rig: PathBuf,
    /// The board file, with the centres as measured.
    #[arg(long, value_name = "FILE")]
    board: PathBuf,
    /// A session, or a directory of images CAMERA/INDEX.png; several for positions captured one by one.
    #[arg(long, value_name = "DIR", required_unless_present = "live", num_args = 1..)]
    session: Vec<PathBuf>,
    /// Be led through the positions of the board: capture each on the nodes, and calibrate at the end.
    #[arg(long, requires = "nodes", conflicts_with = "session")]
    live: bool,
    /// With --live: the nodes' URLs, separated by commas.
    #[arg(long, value_name = "URL,URL", value_delimiter = ',')]
    nodes: Vec<String>,
    #[command(flatten)]
    credentials: Shown,
    /// With --live: sessions are named NAME-p001 and so on.
    #[arg(long, value_name = "NAME", default_value = "calibration")]
    name: String,
    /// With --live: triggers per position, the first in white light, the next with fringes.
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u64).range(2..=100))]
    triggers: u64,
    /// Write the calibration to this file.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Leave out heads that cannot be calibrated instead of refusing.
    #[arg(long)]
    partial: bool,
    /// Positions of the board, counted from 1, in which two of its edges were plumb: they define the vertical.
    #[arg(long, value_name = "POSITION", num_args = 1..)]
    upright: Vec<usize>,
    /// Positions in which the board lay level, face up or down: likewise.
    #[arg(long, value_name = "POSITION", num_args = 1..)]
    level: Vec<usize>,
    /// Write a page with residuals, coverage and advice: DIR/index.html.
    #[arg(long, value_name = "DIR")]
    report: Option<PathBuf>,
    /// Print the result as one JSON object.
    #[arg(long)]
    json: bool,
}

/// Runs `calibrate` and prints what came out.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let rig = Rig::load(&args.rig)?;
    let board = Board::load(&args.board)?;
    let nominal = Calibration::nominal(&rig);
    let cameras: Vec<CameraId> = nominal.cameras().map(|(_, camera)| camera.id.clone()).collect();
    let source = if args.live {
        let nodes = args.credentials.clients(&args.nodes)?;
        let nodes = nodes.into_iter().map(|node| Box::new(node) as Box<dyn Participant>).collect();
        let live = Live { nodes, base: args.name.clone(), triggers: args.triggers };
        calibrate_live::run(&live, &nominal, &board)?
    } else {
        let mut joined = Joined::default();
        for session in &args.session {
            joined.push(vec![open_source(session, &cameras)?]);
        }
        joined
    };
    let lost = tell_lost(source.lost());
    let upright = args.upright.iter().map(|&position| Vertical::Upright(position));
    let level = args.level.iter().map(|&position| Vertical::Level(position));
    let options = run::Options { partial: args.partial, verticals: upright.chain(level).collect() };
    let outcome =
        run::calibrate(&source, &nominal, &board, &options).map_err(|e| Failure::new(exit(&e), e))?;
    outcome.calibration.save(&args.out).map_err(|e| Failure::new(Exit::Failure, e))?;
    let report = |directory: &PathBuf| {
        report::write(&outcome, directory)
            .map_err(|e| Failure::new(Exit::Failure, format!("{}: {e}", directory.display())))
    };
    let page = args.report.as_ref().map(report).transpose()?;
    if args.json {
        println!(
            "{}",
            serde_json::json!({
                "calibration": args.out, "quality": outcome.calibration.quality, "findings": outcome.findings,
                "advice": advice::advice(&outcome), "report": page,
                "unreadable": source.lost().iter().map(ToString::to_string).collect::<Vec<_>>(),
            })
        );
    } else {
        outcome.lines().iter().for_each(|line| println!("{line}"));
        page.iter().chain([&args.out]).for_each(|path| println!("{}", path.display()));
    }
    Ok(if lost { Exit::Corrupt } else { Exit::Done })
}

/// A wrong number after `--upright` is an error of the command line, not of the photographs.
fn exit(error: &run::CalibrateError) -> Exit {
    match error {
        run::CalibrateError::Stage { error: StageError::World(_), .. } => Exit::Usage,
        _ => Exit::Failure,
    }
}
