// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody board`: the calibration board's artwork and its list of circles.

use super::failure::Failure;
use super::tell_files;
use crate::base::Exit;
use crate::base::image::{Mono8, write_png_grey};
use crate::calibrate::{Board, artwork};
use std::path::PathBuf;

/// Write the board's artwork (board.svg to print at scale 1, board.png to look at) and its list of circles (circles.csv).
#[derive(clap::Args)]
#[command(after_help = "Example:\n  fourdbody board --board config/board.toml --out board")]
pub struct Args {
    /// The board file.
    #[arg(long, value_name = "FILE")]
    board: PathBuf,
    /// Where the files go.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Resolution of board.png, pixels per metre.
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = clap::value_parser!(u32).range(50..=20_000))]
    pixels_per_metre: u32,
    /// Print the paths as JSON: {"files": [...]}.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let board = Board::load(&args.board)?;
    let fail = |e: std::io::Error| Failure::failed(format!("{}: {e}", args.out.display()));
    std::fs::create_dir_all(&args.out).map_err(fail)?;
    let mut written = Vec::new();
    let files = [("board.svg", artwork::svg(&board)), ("circles.csv", artwork::csv(&board))];
    for (name, text) in files {
        let path = args.out.join(name);
        std::fs::write(&path, text).map_err(fail)?;
        written.push(path);
    }
    let picture = artwork::picture(&board, f64::from(args.pixels_per_metre));
    let path = args.out.join("board.png");
    write_png_grey(&path, Mono8::from(&picture)).map_err(fail)?;
    written.push(path);
    tell_files(&written, args.json);
    Ok(Exit::Done)
}
