// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody validate`: figures of merit of clouds.

mod distance;
mod girth;
mod plane;
mod spacing;
mod truth;

use super::failure::{Failure, tell_amiss, unusable_clouds};
use crate::base::Exit;
use crate::base::ids::CameraId;
use crate::batch::binned::BinnedSource;
use crate::batch::key::{Key, calibration_path};
use crate::batch::result::{Clouds, Place, calibration_of};
use crate::data::{Calibration, FrameSource};
use nalgebra::Point3;
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

/// Runs the subcommand of `validate`.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    match &args.what {
        What::Plane(args) => plane::run(args),
        What::Distance(args) => distance::run(args),
        What::Spacing(args) => spacing::run(args),
        What::Girth(args) => girth::run(args),
        What::Truth(args) => truth::run(args),
    }
}

fn open_clouds(directory: &Path) -> Result<Clouds, Failure> {
    let clouds = Clouds::open(directory).map_err(|e| unusable_clouds(directory, e))?;
    tell_amiss(&clouds.amiss(&(0..u64::MAX)));
    Ok(clouds)
}

/// Rows of the photographs that make one row of these clouds.
fn bin_rows(clouds: &Path) -> Result<usize, Failure> {
    let key = Key::load(clouds).map_err(|e| Failure::new(Exit::Corrupt, e))?;
    Ok(key.map_or(1, |key| key.bin_rows))
}

/// The given calibration, with rows binned like those of these clouds; without one, the calibration beside the clouds.
fn load_calibration(given: Option<&Path>, clouds: &Path) -> Result<Calibration, Failure> {
    let Some(path) = given else {
        return calibration_of(clouds).map_err(|e| Failure::new(Exit::Usage, e));
    };
    let calibration = Calibration::load(path).map_err(|e| Failure::new(Exit::Usage, e))?;
    Ok(calibration.with_binned_rows(bin_rows(clouds)?))
}

/// The same where it is of use, but not needed.
fn find_calibration(given: Option<&Path>, clouds: &Path) -> Result<Option<Calibration>, Failure> {
    let there = given.is_some() || calibration_path(clouds).exists();
    there.then(|| load_calibration(given, clouds)).transpose()
}

/// The photographs that the clouds were made of, with the rows that these have.
fn open_photographs(
    session: &Path,
    cameras: &[CameraId],
    clouds: &Path,
) -> Result<Box<dyn FrameSource>, Failure> {
    let source = super::reconstruct::open_source(session, cameras)?;
    Ok(BinnedSource::around(source, bin_rows(clouds)?))
}

/// A cloud that is listed must be readable.
fn load_cloud(clouds: &Clouds, place: &Place) -> Result<crate::data::Cloud, Failure> {
    clouds.load(place).map(|(_, cloud)| cloud).map_err(|e| Failure::new(Exit::Corrupt, e))
}

/// An error where nothing was measured: figures of nothing would look like good ones.
fn of_something(figures: usize, clouds: &Path, expected: &str) -> Result<(), Failure> {
    if figures > 0 {
        return Ok(());
    }
    let message = format!("{}: expected {expected}, found none: nothing was measured", clouds.display());
    Err(Failure::new(Exit::Corrupt, message))
}

/// The points of a cloud in the world, m.
fn points(cloud: &crate::data::Cloud) -> impl Iterator<Item = Point3<f64>> {
    cloud.position_m.iter().map(|p| Point3::from(*p).cast::<f64>())
}

/// Mean of some numbers; NaN of none.
fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = values.fold((0.0, 0.0), |(s, n), x| (s + x, n + 1.0));
    sum / n
}
