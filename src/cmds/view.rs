//! `fourdbody view`: a picture of a cloud.

use super::{Exit, Failure, unreadable};
use crate::export::ply;
use crate::export::view::{Style, draw_sides};
use crate::image::write_png_rgb;
use std::path::PathBuf;

/// Draw a cloud as a PNG picture, from one side or several side by side.
#[derive(clap::Args)]
#[command(after_help = "Example:\n  fourdbody view out/merged/000000.ply --out body.png --sides 4")]
pub struct Args {
    /// A directional or merged cloud (PLY).
    cloud: PathBuf,
    /// The picture.
    #[arg(long, value_name = "PNG")]
    out: PathBuf,
    /// Number of views, evenly around the cloud.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=12))]
    sides: u8,
    /// Where the first view is from, degrees: 0 from +x, 90 from +y.
    #[arg(long, default_value_t = 0.0, allow_negative_numbers = true)]
    azimuth: f64,
    /// Rows of the picture.
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u16).range(16..=8000))]
    height: u16,
    /// Colour the points by camera.
    #[arg(long)]
    by_camera: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let (header, cloud) = ply::load(&args.cloud).map_err(|e| unreadable(&args.cloud, e))?;
    if cloud.is_empty() {
        let reason = header.comment("refused").map_or_else(String::new, |reason| format!(" ({reason})"));
        let path = args.cloud.display();
        return Err(Failure::new(Exit::Corrupt, format!("{path}: has no points{reason}; nothing is drawn")));
    }
    let height = usize::from(args.height);
    let style = Style { width: height * 4 / 5, height, by_camera: args.by_camera };
    let picture = draw_sides(&cloud, args.azimuth, usize::from(args.sides), style);
    write_png_rgb(&args.out, picture.width, picture.height, &picture.rgb)
        .map_err(|e| Failure::new(Exit::Failure, format!("{}: {e}", args.out.display())))?;
    println!("{}: {} points", args.out.display(), cloud.len());
    Ok(Exit::Done)
}
