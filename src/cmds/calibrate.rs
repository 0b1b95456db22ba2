// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody calibrate`: from photographs of the board to `calibration.json`.

use super::calibrate_live::{self, Live};
use super::connect::Shown;
use super::failure::{Failure, tell_lost};
use super::progress::Progress;
use crate::base::Exit;
use crate::calibrate::{Board, Vertical, run};
use crate::calibrating;
use crate::capture::participant::Participant;
use crate::config::Rig;
use crate::data::{Calibration, FrameSource};
use std::ops::ControlFlow;
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
    let source = if args.live {
        let nodes = args.credentials.clients(&args.nodes)?;
        let nodes = nodes.into_iter().map(|node| Box::new(node) as Box<dyn Participant>).collect();
        let live = Live { nodes, base: args.name.clone(), triggers: args.triggers };
        calibrate_live::run(&live, &nominal, &board)?
    } else {
        calibrating::open(&args.session, &nominal)?
    };
    let lost = tell_lost(source.lost());
    let upright = args.upright.iter().map(|&position| Vertical::Upright(position));
    let level = args.level.iter().map(|&position| Vertical::Level(position));
    let options = run::Options { partial: args.partial, verticals: upright.chain(level).collect() };
    let progress = Progress::of("photographs", "frames");
    let at = |done: usize, total: usize| {
        progress.at(done as u64, total as u64);
        ControlFlow::Continue(())
    };
    let files = (args.out.as_path(), args.report.as_deref());
    let made = calibrating::calibrate(&source, &nominal, &board, &options, files, &at)?;
    drop(progress);
    if args.json {
        println!("{}", made.json());
    } else {
        made.outcome.lines().iter().for_each(|line| println!("{line}"));
        made.page.iter().chain([&made.out]).for_each(|path| println!("{}", path.display()));
    }
    Ok(if lost { Exit::Corrupt } else { Exit::Done })
}
