// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody calibration check`: do the devices still stand where they stood when they were calibrated? And `import`
//! ([`super::calibration_import`]).

use super::calibration_import::Import;
use super::failure::{Failure, number_in, print, tell_lost};
use super::progress::Progress;
use super::reconstruct::open_source;
use crate::base::ids::CameraId;
use crate::base::{Exit, Scratch};
use crate::batch::files::phase_path;
use crate::batch::key::calibration_sha256;
use crate::batch::run::{self, Plan};
use crate::calibrate::drift::history::{Checked, History, Verdict};
use crate::calibrate::drift::{self, Drift, Kind, Move};
use crate::data::{Calibration, FrameSource, PhaseMap};
use crate::formats::phase_file;
use crate::reconstruct::fringe_order::MostDifference;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

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

/// Number of reconstructions at most, each with the moves that the one before has found.
const ROUNDS: usize = 5;

pub fn run(args: &Args) -> Result<Exit, Failure> {
    match &args.what {
        What::Check(check) => check.run(),
        What::Import(import) => import.run(),
    }
}

/// A session and the calibration that it is compared with.
struct Compared {
    calibration: Calibration,
    source: Box<dyn FrameSource>,
    /// The cameras that both have, in the calibration's order.
    cameras: Vec<CameraId>,
    scratch: Scratch,
}

/// Why there is no drift to report.
enum Unmeasured {
    /// Devices have moved by more than can be measured.
    TooFar(String),
    /// The session does not show how devices stand.
    NotKnown(String),
    Failed(Failure),
}

impl Check {
    fn run(&self) -> Result<Exit, Failure> {
        let calibration = Calibration::load(&self.calibration).map_err(Failure::usage)?;
        let calibrated: Vec<CameraId> = calibration.cameras().map(|(_, camera)| camera.id.clone()).collect();
        let source = open_source(&self.session, &calibrated)?;
        tell_lost(source.lost());
        let both = |id: &CameraId| source.cameras().contains(id);
        let cameras: Vec<CameraId> = calibrated.into_iter().filter(both).collect();
        if cameras.is_empty() {
            let message =
                "expected cameras of the calibration in the session, found none; give that of its rig";
            return Err(Failure::usage(format!("{}: {message}", self.session.display())));
        }
        if let Some(stated) = source.statement() {
            calibration.fits(&cameras, &stated).map_err(Failure::usage)?;
        }
        let unwritable = |dir: &Path, e: &std::io::Error| {
            Failure::failed(format!("the history in {}: {e}", dir.display()))
        };
        let history = self.history.as_ref().map(|dir| History::open(dir).map_err(|e| unwritable(dir, &e)));
        let history = history.transpose()?;
        let scratch = match &history {
            Some(history) => history.scratch(),
            None => std::env::temp_dir().join(format!("fourdbody-check-{}", std::process::id())),
        };
        let compared = Compared { calibration, source, cameras, scratch: Scratch(scratch) };
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(self.jobs.unwrap_or(0))
            .build()
            .map_err(Failure::failed)?;
        let measured = pool.install(|| self.measure(&compared));
        if let Some((history, dir)) = history.zip(self.history.as_ref())
            && let Some(checked) = self.checked(&compared, &measured)?
        {
            history.add(checked).map_err(|e| unwritable(dir, &e))?;
        }
        let drift = measured.map_err(|unmeasured| match unmeasured {
            Unmeasured::TooFar(message) | Unmeasured::NotKnown(message) => {
                Failure::corrupt(format!("{}: {message}", self.session.display()))
            }
            Unmeasured::Failed(failure) => failure,
        })?;
        if let Some(path) = &self.corrected {
            if let Some(reason) = drift.no_better() {
                eprintln!("warning: {} was not written: {reason}", path.display());
            } else {
                let seen_in = self.session.file_name().unwrap_or(self.session.as_os_str()).to_string_lossy();
                let corrected = drift.corrected(&compared.calibration, &seen_in);
                corrected.save(path).map_err(Failure::failed)?;
            }
        }
        self.tell(&drift)
    }

    /// The entry for the history; `None` for a check that failed.
    fn checked(
        &self,
        compared: &Compared,
        measured: &Result<Drift, Unmeasured>,
    ) -> Result<Option<Checked>, Failure> {
        let failed = |e: String| Failure::failed(e);
        let identity = compared.source.identity().map_err(failed)?;
        let name = self.session.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let checked = |verdict, said: &str| Checked {
            recorded_ns: compared.source.recorded_ns().unwrap_or(0),
            session: identity.name.clone().unwrap_or(name),
            session_id: identity.id.clone(),
            calibration_sha256: String::new(),
            verdict,
            said: said.to_owned(),
            most_mm: self.most_mm,
            devices: Vec::new(),
        };
        let checked = match measured {
            Ok(drift) => checked(Verdict::Stands, "").measured(drift),
            Err(Unmeasured::TooFar(message)) => checked(Verdict::CalibrateAgain, message),
            Err(Unmeasured::NotKnown(message)) => checked(Verdict::NotKnown, message),
            Err(Unmeasured::Failed(_)) => return Ok(None),
        };
        let calibration_sha256 = calibration_sha256(&compared.calibration).map_err(failed)?;
        Ok(Some(Checked { calibration_sha256, ..checked }))
    }

    /// The drift, once the cameras agree with what was found.
    fn measure(&self, compared: &Compared) -> Result<Drift, Unmeasured> {
        let (mut known, mut rounds) = (None, 0);
        // With moves that are nearly right fewer fringe orders are wrong, and the next ones are better.
        loop {
            let drift = self.look(compared, known.as_ref())?;
            rounds += 1;
            if drift.is_settled() || rounds == ROUNDS && drift.is_near() {
                return Ok(drift);
            }
            if rounds == ROUNDS {
                return Err(Unmeasured::TooFar(format!(
                    "expected moves of devices with which cameras agree, found that they differ by {:.3} rad after \
                     {ROUNDS} rounds ({:.3} by the calibration): devices have moved too far to be measured; \
                     calibrate again",
                    drift.started_rad, drift.differ_rad[0]
                )));
            }
            known = Some(drift);
        }
    }

    /// The drift, from phases that are made with the calibration as it is corrected by what is known of the drift.
    fn look(&self, compared: &Compared, known: Option<&Drift>) -> Result<Drift, Unmeasured> {
        let corrected = known.map(|known| known.corrected(&compared.calibration, ""));
        let calibration = corrected.as_ref().unwrap_or(&compared.calibration);
        let plan = self.plan(compared);
        let total = plan.shard_triggers().count();
        if total == 0 {
            return Err(Unmeasured::NotKnown("expected frame sets, found none".to_owned()));
        }
        let progress = Progress::of("looking", "frame sets");
        let source = compared.source.as_ref();
        let (summary, _) = run::run(source, calibration, &plan, |done| {
            progress.at(done as u64, total as u64);
            ControlFlow::Continue(())
        })
        .map_err(|e| Unmeasured::Failed(Failure::failed(e)))?;
        let found = plan.shard_triggers().map(|trigger| maps(&plan, calibration, trigger));
        let drift = drift::estimate(&compared.calibration, known, found).map_err(|e| {
            let refused = summary.most_refused_for().map(|reason| format!("; frames are refused: {reason}"));
            Unmeasured::NotKnown(format!("{e}{}", refused.unwrap_or_default()))
        });
        // Phase maps of the next look have the same names.
        let _ = std::fs::remove_dir_all(&plan.out);
        drift
    }

    /// The frame sets to look at: their phases are kept as phase maps whether or not they fit the calibration.
    fn plan(&self, compared: &Compared) -> Plan {
        let triggers = compared.source.triggers();
        let every = (triggers.end - triggers.start).div_ceil(self.frame_sets).max(1);
        // In the middle of each part: people stand still there.
        let shard = ((triggers.start + every / 2) % every, every);
        let (out, cameras) = (compared.scratch.0.clone(), compared.cameras.clone());
        Plan { out, triggers, cameras, shard, most_difference: MostDifference::ANY, ..Plan::default() }
    }

    fn tell(&self, drift: &Drift) -> Result<Exit, Failure> {
        let moved = drift.moved(self.most_mm);
        let (verdict, said) = drift.verdict(self.most_mm);
        let value = serde_json::json!({
            "stands": moved.is_empty(), "verdict": verdict, "said": said, "most_mm": self.most_mm, "drift": drift,
        });
        print(self.json, &value, || {
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
                println!("{said}");
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

/// The phase maps of a trigger that there are, by their camera's place in the calibration.
fn maps(plan: &Plan, calibration: &Calibration, trigger: u64) -> Vec<(usize, PhaseMap)> {
    let load = |(i, id): (usize, &CameraId)| {
        phase_file::load(&phase_path(&plan.out, id.as_str(), trigger)).ok().map(|(_, map)| (i, map))
    };
    let cameras = calibration.cameras().map(|(_, camera)| &camera.id).enumerate();
    cameras.filter(|(_, id)| plan.cameras.contains(id)).filter_map(load).collect()
}
