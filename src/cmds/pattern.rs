//! `fourdbody pattern`: the images to project.

use super::{Exit, Failure};
use crate::config::Rig;
use crate::image::{Mono8, write_png_grey};
use std::path::PathBuf;

/// Write the image that each head projects, as PNG: OUT/HEAD.png.
#[derive(clap::Args)]
#[command(after_help = "Example:\n  fourdbody pattern --rig config/rig.toml --out pattern")]
pub struct Args {
    /// The rig file.
    #[arg(long, value_name = "FILE")]
    rig: PathBuf,
    /// Where the images go.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let rig = Rig::load(&args.rig)?;
    let fail = |e: std::io::Error| Failure::new(Exit::Failure, format!("{}: {e}", args.out.display()));
    std::fs::create_dir_all(&args.out).map_err(fail)?;
    for head in &rig.heads {
        let panel = rig.pattern.panel(head.projector.width, head.projector.height);
        let path = args.out.join(format!("{}.png", head.id));
        write_png_grey(&path, Mono8::from(&panel)).map_err(fail)?;
        println!("{}", path.display());
    }
    Ok(Exit::Done)
}
