//! `fourdbody validate`: figures of merit of clouds.

mod distance;
mod girth;
mod plane;
mod spacing;
mod truth;

use super::{Exit, Failure, unusable_clouds};
use crate::calibrate::Calibration;
use crate::validate::set::CloudSet;
use std::path::Path;

/// Measure clouds against something known.
#[derive(clap::Args)]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand)]
enum What {
    Plane(plane::Args),
    Distance(distance::Args),
    Spacing(spacing::Args),
    Girth(girth::Args),
    Truth(truth::Args),
}

/// Runs the command.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    match &args.what {
        What::Plane(args) => plane::run(args),
        What::Distance(args) => distance::run(args),
        What::Spacing(args) => spacing::run(args),
        What::Girth(args) => girth::run(args),
        What::Truth(args) => truth::run(args),
    }
}

fn open_clouds(directory: &Path) -> Result<CloudSet, Failure> {
    CloudSet::open(directory).map_err(|e| unusable_clouds(directory, e))
}

fn load_calibration(path: &Path) -> Result<Calibration, Failure> {
    Calibration::load(path).map_err(|e| Failure::new(Exit::Usage, e))
}

/// A cloud that is listed must be readable.
fn load_cloud(path: &Path) -> Result<crate::export::Cloud, Failure> {
    crate::validate::set::load(path).map_err(|e| Failure::new(Exit::Corrupt, e))
}

/// Figures of nothing are no figures: an error where there is none.
fn of_something(figures: usize, clouds: &Path, expected: &str) -> Result<(), Failure> {
    if figures > 0 {
        return Ok(());
    }
    let message = format!("{}: expected {expected}, found none: nothing was measured", clouds.display());
    Err(Failure::new(Exit::Corrupt, message))
}

/// Mean of some numbers; NaN of none.
fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = values.fold((0.0, 0.0), |(s, n), x| (s + x, n + 1.0));
    sum / n
}
