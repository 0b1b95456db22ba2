// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody-sim export-png`: rendered frames as PNG files that `fourdbody import` reads.

use crate::cache::{CacheError, CachedImages, Manifest};
use crate::random::{NormalTable, hash, mix, text_number};
use fourdbody::base::Exit;
use fourdbody::base::image::{Mono8, Plane, write_png_grey};
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
    /// The directory in which the images are written.
    #[arg(long)]
    out: PathBuf,
    /// Only these instants: A..B, B not included.
    #[arg(long)]
    instants: Option<String>,
    /// Standard deviation of noise that is added to every pixel, DN: how much does a result depend on it?
    #[arg(long, default_value_t = 0.0)]
    noise_dn: f32,
    /// The seed of the random noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let failed = |e: CacheError| Failure::new(Exit::Failure, e);
    let manifest = Manifest::load(&args.frames).map_err(failed)?;
    let range = match &args.instants {
        None => 0..manifest.instants,
        Some(text) => parse_range(text, manifest.instants).map_err(|e| Failure::new(Exit::Usage, e))?,
    };
    let noise = Noise { table: NormalTable::new(), dn: args.noise_dn, seed: args.seed };
    for camera in &manifest.cameras {
        let images = CachedImages::open(&args.frames, &manifest, &camera.id).map_err(failed)?;
        let folder = args.out.join(camera.id.as_str());
        let written = std::fs::create_dir_all(&folder).and_then(|()| {
            range.clone().into_par_iter().try_for_each(|instant| write(&images, &noise, &folder, instant))
        });
        written.map_err(|e| Failure::new(Exit::Failure, format!("{}: {e}", folder.display())))?;
    }
    println!("{}: {} images of {} cameras", args.out.display(), range.len(), manifest.cameras.len());
    Ok(Exit::Done)
}

/// What is added to the pixels.
struct Noise {
    table: NormalTable,
    dn: f32,
    seed: u64,
}

impl Noise {
    /// The image with the noise of its camera and instant.
    fn on(&self, image: Mono8<'_>, camera: &str, instant: usize) -> Plane<u8> {
        let key = hash(self.seed, &[text_number(camera), instant as u64]);
        Plane::from_fn(image.width(), image.height(), |u, v| {
            let pick = self.table.pick(mix(key ^ (v * image.width() + u) as u64));
            (f32::from(image.row(v)[u]) + self.dn * pick).round().clamp(0.0, 255.0) as u8
        })
    }
}

fn write(images: &CachedImages, noise: &Noise, folder: &Path, instant: usize) -> std::io::Result<()> {
    let image = images.image(instant as i64).ok_or_else(|| std::io::Error::other("image of another size"))?;
    let path = folder.join(format!("{instant:06}.png"));
    if noise.dn == 0.0 {
        return write_png_grey(&path, image);
    }
    let camera = folder.file_name().unwrap_or_default().to_string_lossy();
    write_png_grey(&path, Mono8::from(&noise.on(image, &camera, instant)))
}

fn parse_range(text: &str, instants: usize) -> Result<std::ops::Range<usize>, String> {
    let ends = text.split_once("..").and_then(|(a, b)| Some(a.parse().ok()?..b.parse().ok()?));
    ends.filter(|range: &std::ops::Range<usize>| range.start < range.end && range.end <= instants)
        .ok_or_else(|| format!("--instants {text}: expected A..B with A < B <= {instants}"))
}

#[cfg(test)]
mod tests {
    use super::{Noise, parse_range};
    use crate::random::NormalTable;
    use fourdbody::base::image::{Mono8, Plane};

    #[test]
    fn noise_is_as_large_as_asked_and_the_same_for_a_seed() {
        let image = Plane::filled(200, 200, 100u8);
        let with = |seed, camera| {
            let noise = Noise { table: NormalTable::new(), dn: 2.0, seed };
            noise.on(Mono8::from(&image), camera, 3).as_slice().to_vec()
        };
        let first = with(1, "h0_up");
        let off = |x: &u8| (f64::from(*x) - 100.0).powi(2);
        let sigma = (first.iter().map(off).sum::<f64>() / first.len() as f64).sqrt();
        // Rounding adds 1/12.
        assert!((sigma - 2.02).abs() < 0.05, "{sigma}");
        assert_eq!(first, with(1, "h0_up"));
        assert!(first != with(2, "h0_up") && first != with(1, "h0_low"));
    }

    #[test]
    fn ranges_stay_within_the_sequence() {
        assert_eq!(parse_range("2..4", 4), Ok(2..4));
        for bad in ["4..2", "0..5", "..", "1", "-1..2", "3..3"] {
            assert!(parse_range(bad, 4).is_err(), "{bad}");
        }
    }
}
