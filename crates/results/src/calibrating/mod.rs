// SPDX-License-Identifier: MIT OR Apache-2.0
//! Photographs of the board on disk to a calibration file, and [`check`]: whether a calibration still stands.

pub mod check;

use crate::base::ids::{CameraId, TriggerIndex};
use crate::base::{Exit, Fault};
use crate::batch::whole::open_source;
use crate::calibrate::joined::Joined;
use crate::calibrate::rigging::StageError;
use crate::calibrate::run::{self, CalibrateError, Options, Outcome};
use crate::calibrate::{Board, advice, report};
use crate::data::{Calibration, Frame, FrameSource, SourceStatement};
use crate::record::SessionReader;
use check::At;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

/// A calibration that was made and written.
pub struct Made {
    pub outcome: Outcome,
    /// The calibration file that was written.
    pub out: PathBuf,
    /// The page of its report, where one was asked for.
    pub page: Option<PathBuf>,
    /// Parts of the sessions that cannot be read.
    unreadable: Vec<String>,
}

impl Made {
    /// What the command prints as JSON.
    pub fn json(&self) -> serde_json::Value {
        serde_json::json!({
            "calibration": self.out, "quality": self.outcome.calibration.quality, "findings": self.outcome.findings,
            "advice": advice::advice(&self.outcome), "report": self.page, "unreadable": self.unreadable,
        })
    }
}

/// Sessions, or directories of images, one after the other, as the photographs of one calibration.
pub fn open(sessions: &[PathBuf], nominal: &Calibration) -> Result<Joined, Fault> {
    let cameras: Vec<CameraId> = nominal.cameras().map(|(_, camera)| camera.id.clone()).collect();
    let mut joined = Joined::default();
    for session in sessions {
        joined.push(vec![open_source(session, &cameras, SessionReader::open_frames)?]);
    }
    Ok(joined)
}

/// Calibrates on the current rayon pool, and writes the file, and the report where one is wanted. `at` gets frames that
/// were read and their number, and may end the work: then nothing is written.
pub fn calibrate(
    source: &Joined,
    nominal: &Calibration,
    board: &Board,
    options: &Options,
    (out, report): (&Path, Option<&Path>),
    at: At<'_>,
) -> Result<Made, Fault> {
    let triggers = source.triggers();
    let total = source.cameras().len() * (triggers.end - triggers.start) as usize;
    let watched = Watched { source, at, total, read: AtomicUsize::new(0) };
    let outcome = run::calibrate(&watched, nominal, board, options).map_err(|e| Fault::new(exit(&e), e))?;
    if at(total, total).is_break() {
        return Err(STOPPED.to_owned().into());
    }
    outcome.calibration.save(out).map_err(Fault::failed)?;
    let page = |to: &Path| report::write(&outcome, to).map_err(|e| Fault::at(to, e));
    let page = report.map(page).transpose()?;
    let unreadable = source.lost().iter().map(ToString::to_string).collect();
    Ok(Made { outcome, out: out.to_owned(), page, unreadable })
}

/// A wrong number after `--upright` is an error of the command line, not of the photographs.
fn exit(error: &CalibrateError) -> Exit {
    match error {
        CalibrateError::Stage { error: StageError::World(_), .. } => Exit::Usage,
        _ => Exit::Failure,
    }
}

const STOPPED: &str = "stopped as requested; no calibration was written";

/// Photographs that are counted as they are read.
struct Watched<'a> {
    source: &'a Joined,
    at: At<'a>,
    total: usize,
    read: AtomicUsize,
}

impl FrameSource for Watched<'_> {
    fn cameras(&self) -> &[CameraId] {
        self.source.cameras()
    }

    fn triggers(&self) -> Range<u64> {
        self.source.triggers()
    }

    fn frame(&self, camera: &CameraId, trigger: TriggerIndex) -> Result<Frame<'_>, String> {
        if (self.at)(self.read.fetch_add(1, Ordering::Relaxed), self.total).is_break() {
            return Err(STOPPED.to_owned());
        }
        self.source.frame(camera, trigger)
    }

    fn statement(&self) -> Option<SourceStatement> {
        self.source.statement()
    }
}
