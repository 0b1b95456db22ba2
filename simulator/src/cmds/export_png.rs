//! `fourdbody-sim export-png`: rendered frames as PNG files that `fourdbody import` reads.

use crate::cache::{CacheError, CachedImages, Manifest};
use fourdbody::base::Exit;
use fourdbody::base::image::write_png_grey;
use fourdbody::cmds::Failure;
use rayon::prelude::{IntoParallelIterator, ParallelIterator};
use std::path::{Path, PathBuf};

/// Write rendered frames as `OUT/CAMERA/INDEX.png` (8-bit grey), which `fourdbody import` reads.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  fourdbody-sim export-png --frames target/demo/frames --out target/demo/png --instants 0..4"
)]
pub struct Args {
    /// A directory that `render` wrote.
    #[arg(long)]
    frames: PathBuf,
    /// Where the images go.
    #[arg(long)]
    out: PathBuf,
    /// Only these instants: A..B, B not included.
    #[arg(long)]
    instants: Option<String>,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let failed = |e: CacheError| Failure::new(Exit::Failure, e);
    let manifest = Manifest::load(&args.frames).map_err(failed)?;
    let range = match &args.instants {
        None => 0..manifest.instants,
        Some(text) => parse_range(text, manifest.instants).map_err(|e| Failure::new(Exit::Usage, e))?,
    };
    for camera in &manifest.cameras {
        let images = CachedImages::open(&args.frames, &manifest, &camera.id).map_err(failed)?;
        let folder = args.out.join(camera.id.as_str());
        let written = std::fs::create_dir_all(&folder).and_then(|()| {
            range.clone().into_par_iter().try_for_each(|instant| write(&images, &folder, instant))
        });
        written.map_err(|e| Failure::new(Exit::Failure, format!("{}: {e}", folder.display())))?;
    }
    println!("{}: {} images of {} cameras", args.out.display(), range.len(), manifest.cameras.len());
    Ok(Exit::Done)
}

fn write(images: &CachedImages, folder: &Path, instant: usize) -> std::io::Result<()> {
    let image = images.image(instant as i64).ok_or_else(|| std::io::Error::other("image of another size"))?;
    write_png_grey(&folder.join(format!("{instant:06}.png")), image)
}

fn parse_range(text: &str, instants: usize) -> Result<std::ops::Range<usize>, String> {
    let ends = text.split_once("..").and_then(|(a, b)| Some(a.parse().ok()?..b.parse().ok()?));
    ends.filter(|range: &std::ops::Range<usize>| range.start < range.end && range.end <= instants)
        .ok_or_else(|| format!("--instants {text}: expected A..B with A < B <= {instants}"))
}

#[cfg(test)]
mod tests {
    use super::parse_range;

    #[test]
    fn ranges_stay_within_the_sequence() {
        assert_eq!(parse_range("2..4", 4), Ok(2..4));
        for bad in ["4..2", "0..5", "..", "1", "-1..2", "3..3"] {
            assert!(parse_range(bad, 4).is_err(), "{bad}");
        }
    }
}
