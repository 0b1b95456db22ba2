// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody board`: the calibration board's artwork and its list of circles.

use super::failure::{Failure, print_files};
use crate::base::Exit;
use crate::base::image::{Mono8, write_png_grey};
use crate::calibrate::{Board, artwork};
use std::path::PathBuf;

/// Write the board's artwork (board.svg to print at scale 1, board.png to look at) and its list of circles
/// (circles.csv).
#[derive(clap::Args)]
#[command(after_help = "\
Example:
  fourdbody board --board config/board.toml --out board")]
pub struct Args {
    /// The board file, for instance config/board.toml.
    #[arg(long, value_name = "FILE")]
    board: PathBuf,
    /// The directory for the files; made if it is not there.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Resolution of board.png, pixels per metre.
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = clap::value_parser!(u32).range(50..=20_000))]
    pixels_per_metre: u32,
    /// Print the paths as JSON: {"files": [...]}.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let board = Board::load(&args.board)?;
    let files = ["board.svg", "circles.csv", "board.png"].map(|name| args.out.join(name));
    let [svg, csv, png] = &files;
    let picture = artwork::picture(&board, f64::from(args.pixels_per_metre));
    std::fs::create_dir_all(&args.out)
        .and_then(|()| std::fs::write(svg, artwork::svg(&board)))
        .and_then(|()| std::fs::write(csv, artwork::csv(&board)))
        .and_then(|()| write_png_grey(png, Mono8::from(&picture)))
        .map_err(|e| Failure::at(&args.out, e))?;
    print_files(&files, args.json);
    Ok(Exit::Done)
}
