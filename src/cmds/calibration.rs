// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody calibration check`: do the devices still stand where they stood when they were calibrated?

use super::failure::{Failure, tell_lost};
use super::progress::Progress;
use super::reconstruct::open_source;
use crate::base::Exit;
use crate::base::ids::CameraId;
use crate::batch::from_phase_maps::phase_path;
use crate::batch::run::{self, Plan};
use crate::calibrate::drift::{self, Drift, Turn};
use crate::data::{Calibration, FrameSource, PhaseMap};
use crate::formats::phase_file;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Look after a calibration.
#[derive(clap::Args)]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand)]
enum What {
    Check(Check),
}

/// Measure how far each camera and projector has turned since the calibration, from a session of any body that fills the volume.
///
/// Where two cameras see one place, their phases and the calibration must agree. The turns that explain what does not are told device
/// by device, with their uncertainty, and what they come to at the body. No point of the session has to be right for that: places
/// whose fringe order is wrong fall out.
///
/// Exit codes: 4 a device has surely moved what it sees by more than --most-mm: calibrate again.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  fourdbody calibration check sessions/walk-01 --calibration calibration.json"
)]
struct Check {
    /// A session, or a directory of CAMERA/INDEX.png images.
    session: PathBuf,
    /// The calibration.
    #[arg(long, value_name = "FILE")]
    calibration: PathBuf,
    /// Frame sets that are looked at, evenly over the session.
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u64).range(1..=1000))]
    frame_sets: u64,
    /// What a device may have moved at the body, mm.
    #[arg(long, value_name = "MM", default_value_t = 0.2, value_parser = parse_mm)]
    most_mm: f64,
    /// Write the calibration with these turns here; its origin says so. Not written where the turns do not settle.
    #[arg(long, value_name = "FILE")]
    corrected: Option<PathBuf>,
    /// Print the result as JSON.
    #[arg(long)]
    json: bool,
}

fn parse_mm(text: &str) -> Result<f64, String> {
    let number: Option<f64> = text.parse().ok().filter(|x: &f64| *x > 0.0 && x.is_finite());
    number.ok_or_else(|| format!("expected millimetres above 0, found {text:?}"))
}

/// What is not this many times its own uncertainty may be nothing.
const SURE: f64 = 4.0;

/// A calibration whose cameras differ by less is near enough for its turns to be believed, rad; looks at most.
const SETTLED_RAD: f64 = 0.1;
const ROUNDS: usize = 3;

/// Runs the command.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let What::Check(check) = &args.what;
    check.run()
}

/// A directory that goes when this does.
struct Scratch(PathBuf);

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

impl Check {
    fn run(&self) -> Result<Exit, Failure> {
        let calibration = Calibration::load(&self.calibration).map_err(|e| Failure::new(Exit::Usage, e))?;
        let cameras: Vec<CameraId> = calibration.cameras().map(|(_, camera)| camera.id.clone()).collect();
        let source = open_source(&self.session, &cameras)?;
        tell_lost(source.lost());
        if let Some(stated) = source.statement() {
            calibration.fits(&cameras, &stated).map_err(|e| Failure::new(Exit::Usage, e))?;
        }
        let (mut now, mut first_rad, mut rounds) = (calibration.clone(), None, 0);
        // With turns that are nearly right fewer fringe orders are wrong, and the next ones are better.
        let drift = loop {
            let drift = self.look(source.as_ref(), &now)?;
            let [before, _] = drift.differ_rad;
            now = drift.corrected(&now, "");
            let first_rad = *first_rad.get_or_insert(before);
            rounds += 1;
            if before < SETTLED_RAD {
                break drift.since(&calibration, &now, first_rad);
            }
            if rounds == ROUNDS {
                let message = format!(
                    "{}: expected turns with which cameras differ by less than {SETTLED_RAD} rad, found {before:.3} rad after {ROUNDS} looks ({first_rad:.3} by the calibration): devices have turned too far to be measured; calibrate again",
                    self.session.display()
                );
                return Err(Failure::new(Exit::Corrupt, message));
            }
        };
        if let Some(path) = &self.corrected {
            let seen_in = self.session.file_name().unwrap_or(self.session.as_os_str()).to_string_lossy();
            let corrected = drift.corrected(&calibration, &seen_in);
            corrected.save(path).map_err(|e| Failure::new(Exit::Failure, e))?;
        }
        self.tell(&drift)
    }

    /// The drift from a calibration.
    fn look(&self, source: &dyn FrameSource, calibration: &Calibration) -> Result<Drift, Failure> {
        let corrupt = |e: &dyn std::fmt::Display| {
            Failure::new(Exit::Corrupt, format!("{}: {e}", self.session.display()))
        };
        let scratch = Scratch(std::env::temp_dir().join(format!("fourdbody-check-{}", std::process::id())));
        let cameras = calibration.cameras().map(|(_, camera)| camera.id.clone()).collect();
        let plan = self.plan(&scratch.0, cameras, source.triggers());
        let total = plan.shard_triggers().count();
        if total == 0 {
            return Err(corrupt(&"expected frame sets, found none"));
        }
        let progress = Progress::of("looking", "frame sets");
        let (summary, _) =
            run::run(source, calibration, &plan, |done| progress.at(done as u64, total as u64))
                .map_err(|e| Failure::new(Exit::Failure, e))?;
        drift::estimate(calibration, plan.shard_triggers().map(|trigger| maps(&plan, trigger))).map_err(|e| {
            let refused = summary.most_refused_for().map(|reason| format!("; frames are refused: {reason}"));
            corrupt(&format!("{e}{}", refused.unwrap_or_default()))
        })
    }

    /// The frame sets to look at: their phases are kept as phase maps whatever they say of the calibration.
    fn plan(&self, out: &Path, cameras: Vec<CameraId>, triggers: Range<u64>) -> Plan {
        let every = (triggers.end - triggers.start).div_ceil(self.frame_sets).max(1);
        let most_difference_rad = f32::INFINITY;
        let shard = (triggers.start % every, every);
        Plan { out: out.to_owned(), triggers, cameras, shard, most_difference_rad, ..Plan::default() }
    }

    fn tell(&self, drift: &Drift) -> Result<Exit, Failure> {
        let moved: Vec<&Turn> =
            drift.devices.iter().filter(|turn| turn.at_body_mm > self.most_mm && is_sure(turn)).collect();
        if self.json {
            let stands = moved.is_empty();
            println!("{}", serde_json::json!({ "stands": stands, "most_mm": self.most_mm, "drift": drift }));
        } else {
            println!(
                "{:<20} {:>10} {:>20}   about x, y, z (+-), degree",
                "device", "degree", "mm at the body (+-)"
            );
            for turn in &drift.devices {
                let each = turn.turn_deg.iter().zip(turn.sigma_deg);
                let each: Vec<String> = each.map(|(x, s)| format!("{x:.4} ({s:.4})")).collect();
                let at_body = format!("{:.3} ({:.3})", turn.at_body_mm, turn.at_body_sigma_mm);
                println!("{:<20} {:>10.4} {at_body:>20}   {}", turn.device, turn.angle_deg, each.join(", "));
            }
            let [before, after] = drift.differ_rad;
            println!(
                "{} places that two cameras see: they differ by {before:.3} rad by the calibration, by {after:.3} rad with these turns",
                drift.sightings
            );
        }
        if moved.is_empty() {
            return Ok(Exit::Done);
        }
        let named: Vec<String> = moved
            .iter()
            .map(|turn| {
                format!(
                    "{} has turned by {:.3} degree, {:.2} mm at the body",
                    turn.device, turn.angle_deg, turn.at_body_mm
                )
            })
            .collect();
        let message = format!(
            "expected devices that have moved what they see by at most {} mm, found: {}; calibrate again, or reconstruct with a --corrected calibration",
            self.most_mm,
            named.join("; ")
        );
        Err(Failure::new(Exit::Corrupt, message))
    }
}

fn is_sure(turn: &Turn) -> bool {
    turn.at_body_mm > SURE * turn.at_body_sigma_mm
}

/// The phase maps of a trigger that there are.
fn maps(plan: &Plan, trigger: u64) -> Vec<(usize, PhaseMap)> {
    let load = |(i, camera): (usize, &CameraId)| {
        phase_file::load(&phase_path(&plan.out, camera.as_str(), trigger)).ok().map(|(_, map)| (i, map))
    };
    plan.cameras.iter().enumerate().filter_map(load).collect()
}
