// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody calibration check`: do the devices still stand where they stood when they were calibrated? And `import`
//! ([`super::calibration_import`]).

use super::calibration_import::Import;
use super::failure::{Failure, number_in, print, tell_lost};
use super::progress::Progress;
use crate::base::Exit;
use crate::calibrate::drift::{Kind, Move};
use crate::calibrating::check::{self, Found};
use std::ops::ControlFlow;
use std::path::PathBuf;

/// Check a calibration while it is in use, or make one of another program's.
#[derive(clap::Args)]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand)]
enum What {
    Check(Check),
    Import(Import),
}

/// Measure how each camera, projector and head has moved since the calibration, from a session of any body that fills the
/// volume.
///
/// Where two cameras see one place, their phases and the calibration must agree. Turns, shifts and focal lengths that
/// explain best where they do not agree are printed device by device, with their uncertainty and the displacement that
/// they cause at the body. No point of the session has to be right for that: places whose fringe order is wrong fall out.
///
/// Exit codes: 4 a device has surely moved what it sees by more than --most-mm: calibrate again.
#[derive(clap::Args)]
#[command(after_help = "\
Example:
  fourdbody calibration check sessions/walk-01 --calibration calibration.json")]
struct Check {
    /// A session, or a directory of CAMERA/INDEX.png images.
    session: PathBuf,
    /// The calibration, as `fourdbody calibrate` writes it.
    #[arg(long, value_name = "FILE")]
    calibration: PathBuf,
    /// Frame sets that are looked at, evenly over the session.
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u64).range(1..=1000))]
    frame_sets: u64,
    /// What a device may have moved at the body, mm.
    #[arg(long, value_name = "MM", default_value_t = 0.2)]
    #[arg(value_parser = number_in(f64::MIN_POSITIVE..=f64::MAX, "millimetres above 0"))]
    most_mm: f64,
    /// Write the calibration with these moves here; its origin states so. It is only written if cameras agree better with
    /// it at places that took no part in finding the moves, and no camera agrees less.
    #[arg(long, value_name = "FILE")]
    corrected: Option<PathBuf>,
    /// Number of threads [default: one per core].
    #[arg(long, value_name = "N")]
    jobs: Option<usize>,
    /// Also add the result to the history in this directory, and draw its plot anew.
    #[arg(long, value_name = "DIR")]
    history: Option<PathBuf>,
    /// Print the result as JSON.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    match &args.what {
        What::Check(check) => check.run(),
        What::Import(import) => import.run(),
    }
}

impl Check {
    fn run(&self) -> Result<Exit, Failure> {
        let compared = check::Check {
            session: self.session.clone(),
            calibration: self.calibration.clone(),
            frame_sets: self.frame_sets,
            most_mm: self.most_mm,
            corrected: self.corrected.clone(),
            history: self.history.clone(),
        }
        .open()?;
        tell_lost(compared.lost());
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(self.jobs.unwrap_or(0))
            .build()
            .map_err(Failure::failed)?;
        let progress = Progress::of("looking", "frame sets");
        let at = |done: usize, total: usize| {
            progress.at(done as u64, total as u64);
            ControlFlow::Continue(())
        };
        let found = pool.install(|| compared.run(&at))?;
        drop(progress);
        if let Some((reason, path)) = found.no_better.as_ref().zip(self.corrected.as_ref()) {
            eprintln!("warning: {} was not written: {reason}", path.display());
        }
        self.tell(&found)
    }

    fn tell(&self, found: &Found) -> Result<Exit, Failure> {
        let drift = &found.drift;
        let moved = drift.moved(self.most_mm);
        print(self.json, &found.json(), || {
            println!("{:<20} {:>20}   what has happened", "device", "mm at the body (+-)");
            for device in &drift.devices {
                let at_body = format!("{:.3} ({:.3})", device.at_body_mm, device.at_body_sigma_mm);
                println!("{:<20} {at_body:>20}   {}", device.device, numbers(device));
            }
            let ([before, after], [held_before, held_after]) = (drift.differ_rad, drift.held_back.differ_rad);
            println!(
                "{} places that two cameras see: they differ by {before:.3} rad by the calibration, by {after:.3} \
                 rad with these moves; at {} of them, which took no part (RMS): {held_before:.3} and {held_after:.3} rad",
                drift.sightings, drift.held_back.places
            );
            if moved.is_empty() {
                println!("{}", drift.verdict(self.most_mm).1);
            }
        });
        if moved.is_empty() {
            return Ok(Exit::Done);
        }
        let named: Vec<String> = moved.iter().map(ToString::to_string).collect();
        let message = format!(
            "expected devices that have moved what they see by at most {} mm, found: {}; calibrate again, or \
             reconstruct with a --corrected calibration",
            self.most_mm,
            named.join("; ")
        );
        Err(Failure::corrupt(message))
    }
}

/// What has happened to a device, with standard deviations.
fn numbers(device: &Move) -> String {
    let three = |values: [f64; 3], sigmas: [f64; 3], digits: usize| {
        let each = values.iter().zip(sigmas).map(|(x, s)| format!("{x:.digits$} ({s:.digits$})"));
        each.collect::<Vec<String>>().join(", ")
    };
    let turned = || format!("turned by {} degree", three(device.turn_deg, device.sigma_deg, 4));
    let shifted = || format!("shifted by {} mm", three(device.shift_mm, device.shift_sigma_mm, 3));
    let words = device.kinds.iter().map(|kind| match kind {
        Kind::Turn => turned(),
        Kind::Shift => shifted(),
        Kind::FocalLength => {
            format!("focal length {:+.4} ({:.4}) %", device.focal_percent, device.focal_sigma_percent)
        }
        Kind::Whole => format!("{}, {}", turned(), shifted()),
    });
    let words: Vec<String> = words.collect();
    if words.is_empty() { "nothing".to_owned() } else { words.join(", ") }
}
