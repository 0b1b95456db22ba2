// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody-sim compare-rig`: a calibration against the true rig.

use crate::compare::{Comparison, compare, moved};
use fourdbody::base::Exit;
use fourdbody::cmds::Failure;
use fourdbody::data::Calibration;
use std::path::{Path, PathBuf};

/// Compare a calibration with the true geometry that `render` wrote, point by point of the working volume.
///
/// A calibration's world is its own choice: the comparison is made after the rigid motion that fits best, and the
/// motion is reported. With --aligned the calibration is also written in the true world, so that what it measures can
/// be compared with ground truth; nothing but the world changes.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  fourdbody-sim compare-rig --found calibration.json --truth target/frames/calibration.json --aligned aligned.json"
)]
pub struct Args {
    /// The calibration that is compared with the truth.
    #[arg(long, value_name = "FILE")]
    found: PathBuf,
    /// The calibration file with the true geometry.
    #[arg(long, value_name = "FILE")]
    truth: PathBuf,
    /// Where to write the calibration in the true world.
    #[arg(long, value_name = "FILE")]
    aligned: Option<PathBuf>,
    /// Print one JSON object instead of text.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let load = |path: &Path| Calibration::load(path).map_err(|e| Failure::new(Exit::Usage, e));
    let (found, truth) = (load(&args.found)?, load(&args.truth)?);
    let comparison = compare(&found, &truth).map_err(|e| Failure::new(Exit::Usage, e))?;
    if let Some(path) = &args.aligned {
        let aligned = moved(&found, &comparison.true_from_found);
        aligned.save(path).map_err(|e| Failure::new(Exit::Failure, e))?;
    }
    if args.json {
        println!("{}", serde_json::json!(comparison));
    } else {
        print(&comparison);
    }
    Ok(Exit::Done)
}

fn print(comparison: &Comparison) {
    for (head, distances) in &comparison.heads {
        let (rms, max) = (distances.rms_mm, distances.max_mm);
        println!(
            "{head}: {rms:.4} mm rms, {max:.4} mm at most, over {} points of the volume",
            distances.points
        );
    }
    let all = &comparison.together;
    println!("all heads in one world: {:.4} mm rms, {:.4} mm at most", all.rms_mm, all.max_mm);
    println!(
        "its world: {:.3} degrees from upright, {:.1} mm from the true one in the middle of the volume",
        comparison.tilt_deg, comparison.shift_mm
    );
}
