// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether the devices still stand where they stood when they were calibrated, by the photographs of a session.

use crate::base::ids::CameraId;
use crate::base::{Fault, Scratch};
use crate::batch::files::phase_path;
use crate::batch::key::calibration_sha256;
use crate::batch::run::{self, Plan};
use crate::batch::whole::open_source;
use crate::calibrate::drift::history::{Checked, History, Verdict};
use crate::calibrate::drift::{self, Drift};
use crate::data::{Calibration, FrameSource, LostPart, PhaseMap};
use crate::formats::phase_file;
use crate::reconstruct::fringe_order::MostDifference;
use crate::record::SessionReader;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// Number of reconstructions at most, each with the moves that the one before has found.
const ROUNDS: usize = 5;

/// What a check looks at, and where it writes.
#[derive(Debug, Clone)]
pub struct Check {
    /// A session, or a directory of CAMERA/INDEX.png images.
    pub session: PathBuf,
    /// The calibration that is checked.
    pub calibration: PathBuf,
    /// Frame sets that are looked at, evenly over the session; at least 1.
    pub frame_sets: u64,
    /// What a device may have moved at the body, mm.
    pub most_mm: f64,
    /// Where the calibration with the moves goes, if cameras agree better with it.
    pub corrected: Option<PathBuf>,
    /// The directory of the history that the result is added to.
    pub history: Option<PathBuf>,
}

/// What a check has found.
pub struct Found {
    pub drift: Drift,
    most_mm: f64,
    /// Why the corrected calibration that was asked for was not written.
    pub no_better: Option<String>,
}

impl Found {
    /// The verdict, the sentence that says it, and what each device has done, as the command prints it.
    pub fn json(&self) -> serde_json::Value {
        let (verdict, said) = self.drift.verdict(self.most_mm);
        let stands = self.drift.moved(self.most_mm).is_empty();
        serde_json::json!({
            "stands": stands, "verdict": verdict, "said": said, "most_mm": self.most_mm, "drift": self.drift,
        })
    }
}

/// A session and the calibration that it is compared with.
pub struct Compared {
    check: Check,
    calibration: Calibration,
    source: Box<dyn FrameSource>,
    /// The cameras that both have, in the calibration's order.
    cameras: Vec<CameraId>,
}

/// Why there is no drift to report.
enum Unmeasured {
    /// Devices have moved by more than can be measured.
    TooFar(String),
    /// The session does not show how devices stand.
    NotKnown(String),
    Failed(Fault),
}

/// Gets frame sets done and their number in each round, and may end the check.
pub type At<'a> = &'a (dyn Fn(usize, usize) -> ControlFlow<()> + Sync);

impl Check {
    /// Opens session and calibration, which must belong together.
    pub fn open(self) -> Result<Compared, Fault> {
        let calibration = Calibration::load(&self.calibration).map_err(Fault::usage)?;
        let calibrated: Vec<CameraId> = calibration.cameras().map(|(_, camera)| camera.id.clone()).collect();
        let source = open_source(&self.session, &calibrated, SessionReader::open_frames)?;
        let both = |id: &CameraId| source.cameras().contains(id);
        let cameras: Vec<CameraId> = calibrated.into_iter().filter(both).collect();
        if cameras.is_empty() {
            let message =
                "expected cameras of the calibration in the session, found none; give that of its rig";
            return Err(Fault::usage(format!("{}: {message}", self.session.display())));
        }
        if let Some(stated) = source.statement() {
            calibration.fits(&cameras, &stated).map_err(Fault::usage)?;
        }
        Ok(Compared { check: self, calibration, source, cameras })
    }
}

impl Compared {
    /// Parts of the session that cannot be read.
    pub fn lost(&self) -> &[LostPart] {
        self.source.lost()
    }

    /// Measures the drift on the current rayon pool, and writes what was asked for.
    pub fn run(&self, at: At<'_>) -> Result<Found, Fault> {
        let Check { session, most_mm, .. } = &self.check;
        let unwritable =
            |dir: &Path, e: &std::io::Error| Fault::failed(format!("the history in {}: {e}", dir.display()));
        let dir = self.check.history.as_deref();
        let history = dir.map(|dir| History::open(dir).map_err(|e| unwritable(dir, &e))).transpose()?;
        // One process may have several checks under way.
        static NUMBER: AtomicU64 = AtomicU64::new(0);
        let scratch = Scratch(match &history {
            Some(history) => history.scratch(),
            None => std::env::temp_dir().join(format!(
                "fourdbody-check-{}-{}",
                std::process::id(),
                NUMBER.fetch_add(1, Ordering::Relaxed)
            )),
        });
        let measured = self.measure(&scratch.0, at);
        if let Some((history, dir)) = history.zip(dir)
            && let Some(checked) = self.checked(&measured)?
        {
            history.add(checked).map_err(|e| unwritable(dir, &e))?;
        }
        let drift = measured.map_err(|unmeasured| match unmeasured {
            Unmeasured::TooFar(message) | Unmeasured::NotKnown(message) => {
                Fault::corrupt(format!("{}: {message}", session.display()))
            }
            Unmeasured::Failed(fault) => fault,
        })?;
        let no_better = self.check.corrected.as_ref().and_then(|_| drift.no_better());
        if let Some(path) = self.check.corrected.as_ref().filter(|_| no_better.is_none()) {
            let seen_in = session.file_name().unwrap_or(session.as_os_str()).to_string_lossy();
            drift.corrected(&self.calibration, &seen_in).save(path).map_err(Fault::failed)?;
        }
        Ok(Found { drift, most_mm: *most_mm, no_better })
    }

    /// The entry for the history; `None` for a check that failed.
    fn checked(&self, measured: &Result<Drift, Unmeasured>) -> Result<Option<Checked>, Fault> {
        let failed = |e: String| Fault::failed(e);
        let identity = self.source.identity().map_err(failed)?;
        let name = self.check.session.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let checked = |verdict, said: &str| Checked {
            recorded_ns: self.source.recorded_ns().unwrap_or(0),
            session: identity.name.clone().unwrap_or(name),
            session_id: identity.id.clone(),
            calibration_sha256: String::new(),
            verdict,
            said: said.to_owned(),
            most_mm: self.check.most_mm,
            devices: Vec::new(),
        };
        let checked = match measured {
            Ok(drift) => checked(Verdict::Stands, "").measured(drift),
            Err(Unmeasured::TooFar(message)) => checked(Verdict::CalibrateAgain, message),
            Err(Unmeasured::NotKnown(message)) => checked(Verdict::NotKnown, message),
            Err(Unmeasured::Failed(_)) => return Ok(None),
        };
        let calibration_sha256 = calibration_sha256(&self.calibration).map_err(failed)?;
        Ok(Some(Checked { calibration_sha256, ..checked }))
    }

    /// The drift, once the cameras agree with what was found.
    fn measure(&self, scratch: &Path, at: At<'_>) -> Result<Drift, Unmeasured> {
        let (mut known, mut rounds) = (None, 0);
        // With moves that are nearly right fewer fringe orders are wrong, and the next ones are better.
        loop {
            let drift = self.look(scratch, known.as_ref(), at)?;
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
    fn look(&self, scratch: &Path, known: Option<&Drift>, at: At<'_>) -> Result<Drift, Unmeasured> {
        let corrected = known.map(|known| known.corrected(&self.calibration, ""));
        let calibration = corrected.as_ref().unwrap_or(&self.calibration);
        let plan = self.plan(scratch);
        let total = plan.shard_triggers().count();
        if total == 0 {
            return Err(Unmeasured::NotKnown("expected frame sets, found none".to_owned()));
        }
        let source = self.source.as_ref();
        let (summary, _) =
            run::run(source, calibration, &plan, |done| at(done, total)).map_err(Unmeasured::Failed)?;
        let found = plan.shard_triggers().map(|trigger| maps(&plan, calibration, trigger));
        let drift = drift::estimate(&self.calibration, known, found).map_err(|e| {
            let refused = summary.most_refused_for().map(|reason| format!("; frames are refused: {reason}"));
            Unmeasured::NotKnown(format!("{e}{}", refused.unwrap_or_default()))
        });
        // Phase maps of the next look have the same names.
        let _ = std::fs::remove_dir_all(&plan.out);
        drift
    }

    /// The frame sets to look at: their phases are kept as phase maps whether or not they fit the calibration.
    fn plan(&self, scratch: &Path) -> Plan {
        let triggers = self.source.triggers();
        let every = (triggers.end - triggers.start).div_ceil(self.check.frame_sets).max(1);
        // In the middle of each part: people stand still there.
        let shard = ((triggers.start + every / 2) % every, every);
        let (out, cameras) = (scratch.to_owned(), self.cameras.clone());
        Plan { out, triggers, cameras, shard, most_difference: MostDifference::ANY, ..Plan::default() }
    }
}

/// The phase maps of a trigger that there are, by their camera's place in the calibration.
fn maps(plan: &Plan, calibration: &Calibration, trigger: u64) -> Vec<(usize, PhaseMap)> {
    let load = |(i, id): (usize, &CameraId)| {
        phase_file::load(&phase_path(&plan.out, id.as_str(), trigger)).ok().map(|(_, map)| (i, map))
    };
    let cameras = calibration.cameras().map(|(_, camera)| &camera.id).enumerate();
    cameras.filter(|(_, id)| plan.cameras.contains(id)).filter_map(load).collect()
}
