// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody pattern`: the images to project.

use super::failure::{Failure, number_in, print_files};
use crate::base::Exit;
use crate::base::image::{Mono8, write_png_grey};
use crate::config::Rig;
use std::path::PathBuf;

/// Write the image that each head projects, as PNG: OUT/HEAD.png.
#[derive(clap::Args)]
#[command(after_help = "\
Example:
  fourdbody pattern --rig config/rig.toml --out pattern
  fourdbody pattern --rig config/rig.toml --out pattern --gamma 2.2")]
pub struct Args {
    /// The rig file, for instance config/rig.toml.
    #[arg(long, value_name = "FILE")]
    rig: PathBuf,
    /// The directory for the images; made if it is not there.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Exponent by which the projectors turn panel values into light, in place of the rig file's: the images undo it.
    /// `fourdbody calibrate` measures it.
    #[arg(long, value_name = "G", value_parser = number_in(0.2..=5.0, "an exponent from 0.2 to 5, for instance 2.2"))]
    gamma: Option<f64>,
    /// Print the paths as JSON: {"files": [...]}.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let mut rig = Rig::load(&args.rig)?;
    rig.pattern.gamma = args.gamma.unwrap_or(rig.pattern.gamma);
    let fail = |e: std::io::Error| Failure::at(&args.out, e);
    std::fs::create_dir_all(&args.out).map_err(fail)?;
    let mut files = Vec::new();
    for head in &rig.heads {
        let panel = rig.pattern.panel(head.projector.width, head.projector.height);
        let path = args.out.join(format!("{}.png", head.id));
        write_png_grey(&path, Mono8::from(&panel)).map_err(fail)?;
        files.push(path);
    }
    print_files(&files, args.json);
    Ok(Exit::Done)
}
